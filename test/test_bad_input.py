"""Whatever is wrong with what the user gives, one sentence says where, what, and what to do."""

import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import trimesh
from meshes import box
from ruamel.yaml import YAML

from bench.commands import app as bench
from cutting_trainer.bags import recorder_node as recorder_node
from cutting_trainer.cli import main as cli
from cutting_trainer.haptic_bridge import scene_schema
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import find_scene

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / 'bags' / 'samples' / 'format_2' / 'palpation'


@dataclass(frozen=True)
class Bad:
    """A kind of bad input.

    Attributes:
        kind: what is wrong.
        prepare: makes the input in a folder; returns the arguments of the command line.
        says: place, value and remedy, as the sentence must have them; `{}` is the folder.
    """

    kind: str
    prepare: Callable[[Path], list[str]]
    says: tuple[str, ...]


def scene_with(changes: dict[str, Any], folder: Path) -> Path:
    """The shipped block with some keys otherwise; ... takes one out."""
    scene = YAML(typ='safe').load(find_scene('block'))
    scene['tissue']['mesh'] = str(ROOT / 'config' / 'meshes' / 'block_yi2007.msh')
    for dotted, value in changes.items():
        *path, last = [int(part) if part.isdecimal() else part for part in dotted.split('.')]
        place = scene
        for part in path:
            place = place[part]
        if value is ...:
            del place[last]
        else:
            place[last] = value
    file = folder / 'mine.yaml'
    with file.open('w') as out:
        YAML().dump(scene, out)
    return file


def scene(kind: str, key: str, value: Any, *says: str) -> Bad:
    def prepare(folder: Path) -> list[str]:
        return ['demo', '--domain', 'free', '--scene', str(scene_with({key: value}, folder))]

    return Bad(f'scene: {kind}', prepare, ('{}/mine.yaml', *says))


def text(kind: str, content: str | bytes, *says: str) -> Bad:
    def prepare(folder: Path) -> list[str]:
        data = content.encode() if isinstance(content, str) else content
        (folder / 'mine.yaml').write_bytes(data)
        return ['plan', str(folder / 'mine.yaml')]

    return Bad(f'scene file: {kind}', prepare, ('{}/mine.yaml', *says))


MODULUS = 'tissue.material.youngs_modulus'
SCENES = [
    scene('unknown section', 'tisue', {}, 'tisue', 'did you mean tissue?'),
    scene('unknown key', 'tissue.unt', 'mm', 'tissue.unt', 'did you mean unit?'),
    scene('unknown key without a neighbour', 'tool.qqq', 1, 'tool.qqq', 'known are'),
    scene('unknown nested key', 'tissue.material.tougness', 9, 'tougness', 'did you mean tough'),
    scene('missing section', 'tissue', ..., 'tissue is missing', 'it needs mesh'),
    scene('missing key', 'tissue.mesh', ..., 'mesh is missing', 'meshio'),
    scene('section is a list', 'tool', [1], 'tool is a list', 'mapping'),
    scene('mesh is not there', 'tissue.mesh', 'no.msh', 'tissue.mesh', 'no.msh', 'check the path'),
    scene('mesh is a folder', 'tissue.mesh', '/etc', 'tissue.mesh', '/etc', 'name the file'),
    scene('mesh is a number', 'tissue.mesh', 3, 'tissue.mesh', '3', 'string'),
    scene('unknown unit', 'tissue.unit', 'inch', 'tissue.unit', "'inch'", "'m', 'cm' or 'mm'"),
    scene('negative density', 'tissue.material.density', -1, 'density', '-1', '[kg/m^3]'),
    scene('modulus in kPa', MODULUS, 9, MODULUS, '9', '[Pa]'),
    scene('modulus is NaN', MODULUS, float('nan'), MODULUS, 'NaN', 'finite'),
    scene('modulus is infinite', MODULUS, float('inf'), MODULUS, 'Infinity', 'finite'),
    scene('incompressible', 'tissue.material.poissons_ratio', 0.5,
          'poissons_ratio', '0.5', 'less than 0.5'),
    scene('word for a number', 'tool.radius', 'thin', 'tool.radius', "'thin'", 'number'),
    scene('number in quotes', 'tool.radius', '0.003', 'tool.radius', "'0.003'", 'number'),
    scene('truth for a number', 'tool.radius', True, 'tool.radius', 'true', 'number'),
    scene('nothing for a number', 'tool.radius', None, 'tool.radius', 'null', 'number'),
    scene('list for a number', 'tool.radius', [1], 'tool.radius', '[1]', 'number'),
    scene('radius of zero', 'tool.radius', 0, 'tool.radius', '0', '0.00001'),
    scene('radius of a point', 'tool.radius', 9e-6, 'tool.radius', '9e-06', '0.00001'),
    scene('friction below 0', 'tissue.material.friction', -0.1, 'friction', '-0.1', 'greater'),
    scene('radius in mm', 'tool.radius', 3, 'tool.radius', '3', '[m]'),
    scene('coupling pulls', 'tool.coupling_stiffness', -5, 'coupling_stiffness', '-5', '[N/m]'),
    scene('negative damping', 'tissue.damping', {'alpha': -1}, 'damping.alpha', '-1', 'greater'),
    scene('negative threshold', 'tissue.cut_threshold', -1, 'cut_threshold', '-1', '[N]'),
    scene('fraction for a count', 'tissue.integration', {'max_substeps': 2.5},
          'max_substeps', '2.5', 'integer'),
    scene('rate of zero', 'haptics.rate', 0, 'haptics.rate', '0', '[Hz]'),
    scene('unknown model', 'tissue.model', 'linaer', 'tissue.model', "'linaer'", "'linear'"),
    scene('unknown method of cutting', 'cutting.method', 'tear', 'cutting.method', "'tear'", "'"),
    scene('no region is fixed', 'tissue.fixed', [], 'tissue.fixed', '[]', 'at least 1'),
    scene('region in mm', 'tissue.fixed', [{'below': {'axis': 'z', 'value': 20}}],
          'tissue.fixed.0.below.value', '20', '[m]'),
    scene('unknown axis', 'tissue.fixed', [{'below': {'axis': 'w', 'value': 0.01}}],
          'tissue.fixed.0.below.axis', "'w'", "'x', 'y' or 'z'"),
    scene('unknown device', 'device.profile', 'tuch', 'device.profile', 'tuch', 'mean touch?'),
    scene('stiffer than the device', 'tool.coupling_stiffness', 9e3,
          'coupling_stiffness', '9000', 'max_stiffness'),
    scene('fade too fast', 'haptics.fade', 1e-4, 'haptics.fade', '0.0001', '0.005'),
    scene('frames too rare for the force', 'tissue.integration', {'rate': 5},
          'haptics.stale_after', '5 frames', 'rate to 12 at least'),
    scene('fewest substeps above the most', 'tissue.integration', {'min_substeps': 300},
          'min_substeps 300', 'max_substeps 200', 'exchange'),
    scene('device two kilometres away', 'device.tissue_from_device.translation', [0, 0, 2000],
          'translation', '2000', '[m]'),
    scene('publisher that is no node', 'device.accepted_publishers', ['arm'],
          'accepted_publishers', "'arm'", '/name'),
    scene('tool that no namespace can have', 'tools', {'a__b': {}}, 'a__b'),
    scene('duration of a week', 'session.seconds', 6e5, 'session.seconds', '600000', '86400'),
    text('empty', '', 'is empty', 'sections tissue'),
    text('a list', '- tissue\n', 'is a list', 'mapping of the sections'),
    text('bracket left open', 'tool: [1\n', 'column', 'check indentation'),
    text('tabulator', 'tool:\n\tradius: 1\n', 'column', 'check indentation'),
    text('key twice', 'tool: {}\ntool: {}\n', 'tool is given twice', 'line 1', 'delete one'),
    text('bytes that are no text', b'tool: \xff', 'byte 6', 'a scene is a YAML file'),
    Bad('scene: no such file', lambda f: ['plan', str(f / 'mine.yaml')],
        ('{}/mine.yaml', 'does not exist', 'check the path')),
    Bad('scene: no such name', lambda f: ['plan', 'livr'], ("'livr'", 'did you mean liver?')),
    Bad('scene: a folder', lambda f: ['bench', 'stability', str(f) + '/'],
        ('{}', 'is a folder', 'name')),
]  # fmt: skip


def mesh(kind: str, change: Callable[[np.ndarray, np.ndarray], Any], *says: str) -> Bad:
    """A mesh of 2 x 2 x 2 cubes of 6 tetrahedra, changed, in a scene."""

    def prepare(folder: Path) -> list[str]:
        nodes, tetrahedra = box((2, 2, 2), 0.02)
        changed = change(nodes.copy(), tetrahedra.copy())
        nodes, cells = changed if changed else (nodes, tetrahedra)
        cells = cells if isinstance(cells, list) else [('tetra', cells)]
        meshio.Mesh(nodes, cells).write(folder / 'organ.vtk')
        fixed = [{'below': {'axis': 'z', 'value': 1e-4}}]
        changes = {'tissue.mesh': str(folder / 'organ.vtk'), 'tissue.fixed': fixed}
        return ['bench', 'stability', str(scene_with(changes | {'tissue.unit': 'm'}, folder))]

    return Bad(f'mesh: {kind}', prepare, ('{}/organ.vtk', *says))


def set_to(node: int, axis: int, value: float) -> Callable[[np.ndarray, np.ndarray], Any]:
    def change(nodes: np.ndarray, tetrahedra: np.ndarray) -> Any:
        nodes[node, axis] = value
        return nodes, tetrahedra

    return change


def flat(nodes: np.ndarray, tetrahedra: np.ndarray) -> Any:
    return nodes, np.vstack((tetrahedra, [[0, 3, 9, 12]]))


def collapsed(nodes: np.ndarray, tetrahedra: np.ndarray) -> Any:
    nodes[:, 2] = 0.0
    return nodes, tetrahedra


def apart(nodes: np.ndarray, tetrahedra: np.ndarray) -> Any:
    return np.vstack((nodes, nodes + np.eye(3)[2])), np.vstack(
        (tetrahedra, tetrahedra + len(nodes))
    )


def folded(nodes: np.ndarray, tetrahedra: np.ndarray) -> Any:
    nodes[13] = nodes[13] + [0.05, 0.0, 0.0]
    return nodes, tetrahedra


def twice(nodes: np.ndarray, tetrahedra: np.ndarray) -> Any:
    return nodes, np.vstack((tetrahedra, tetrahedra[:1]))


def broken(kind: str, name: str, content: bytes, *says: str) -> Bad:
    def prepare(folder: Path) -> list[str]:
        (folder / name).write_bytes(content)
        return ['bench', 'stability', str(scene_with({'tissue.mesh': str(folder / name)}, folder))]

    return Bad(f'mesh: {kind}', prepare, (f'{{}}/{name}', *says))


MESHES = [
    mesh('NaN in a node', set_to(3, 1, np.nan), 'node 3', 'nan', 'export'),
    mesh('infinite node', set_to(3, 1, np.inf), 'node 3', 'inf', 'export'),
    mesh('unit wrong by 1000', lambda n, t: (n * 1e3, t), '40', 'unit'),
    mesh('unit wrong by 1/1000', lambda n, t: (n * 1e-3, t), '4e-05', 'unit'),
    mesh('element without volume', flat, 'tetrahedron 48', 'volume', 'mesh'),
    mesh('nodes on each other', collapsed, 'nodes 0 and 1', '(0, 0, 0) m', 'merge'),
    mesh('folded', folded, 'tetrahedr', 'mesh'),
    mesh('element twice', twice, 'tetrahedron 48', '[0, 9, 12, 13]', 'delete one'),
    mesh('two parts, one loose', apart, 'fixed', 'node'),
    mesh('open surface', lambda n, t: (n, [('triangle', t[:, :3])]), 'no tetrahedra', 'mesher'),
    mesh('second order', lambda n, t: (n, [('tetra10', np.hstack((t, t, t))[:, :10])]),
         'tetra10', 'first order'),
    mesh('bricks', lambda n, t: (n, [('hexahedron', np.arange(8)[None])]), 'hexahedron', 'tetra'),
    broken('no content', 'organ.msh', b'', 'cannot be read', 'export'),
    broken('text', 'organ.msh', b'my organ\n', 'cannot be read', 'export'),
    broken('unknown format', 'organ.xyz', b'0 0 0', 'cannot be read', 'export'),
    broken('noise', 'organ.vtk', bytes(range(256)), 'cannot be read', 'export'),
]  # fmt: skip


def surface(kind: str, make: Callable[[trimesh.Trimesh], Any], *says: str, **options: str) -> Bad:
    """A ball of 30 mm, changed, to be imported."""

    def prepare(folder: Path) -> list[str]:
        made = make(trimesh.creation.icosphere(2, 30.0))
        if isinstance(made, bytes):
            (folder / 'organ.ply').write_bytes(made)
        else:
            made.export(folder / 'organ.ply')
        words = [word for name, value in options.items() for word in (f'--{name}', value)]
        return ['import-mesh', str(folder / 'organ.ply'), '-o', str(folder / 'out'), *words]

    return Bad(f'surface: {kind}', prepare, ('{}/organ.ply', *says))


def opened(ball: trimesh.Trimesh) -> trimesh.Trimesh:
    ball.update_faces(ball.triangles_center[:, 2] < 20.0)
    return ball


def moved(ball: trimesh.Trimesh) -> trimesh.Trimesh:
    ball.vertices[5] = np.nan
    return ball


def crossed(ball: trimesh.Trimesh) -> trimesh.Trimesh:
    second = ball.copy()
    second.apply_translation([40.0, 0.0, 0.0])
    return trimesh.util.concatenate([ball, second])


def pressed(ball: trimesh.Trimesh) -> trimesh.Trimesh:
    ball.vertices[:, 2] *= 1e-3
    return ball


def ordered(kind: str, words: list[str], *says: str) -> Bad:
    """What may be asked of a sound surface, and is wrong; `{}` is the folder."""

    def prepare(folder: Path) -> list[str]:
        trimesh.creation.icosphere(2, 30.0).export(folder / 'organ.stl')
        (folder / 'taken.msh').touch()
        return ['import-mesh', str(folder / 'organ.stl'), *(w.format(folder) for w in words)]

    return Bad(f'import: {kind}', prepare, says)


OUT = ['-o', '{}/out']
SURFACES = [
    surface('open', opened, 'is not closed', 'edges', 'near (', 'close it'),
    surface('vertex is NaN', moved, 'vertex 5', 'nan', 'export'),
    surface('shells that cross', crossed, '2 shells cross each other', ') m', 'unite them'),
    surface('as thin as paper', pressed, '0.06 mm thick', '--unit'),
    surface('unit wrong by 1000', lambda b: b, '60 m', '--unit', unit='m'),
    surface('empty', lambda b: b'', 'is empty', 'export'),
    surface('no surface at all', lambda b: b'my organ', 'cannot be read'),
    surface('points only', lambda b: trimesh.PointCloud(b.vertices), 'no triangles', 'export'),
    ordered('side that is none', [*OUT, '--rests-on', 'down'], '--rests-on', 'down', '-z'),
    ordered('edge too small', [*OUT, '--edge', '0.0002'], '--edge', '0.0002', 'take at least'),
    ordered('edge too large', [*OUT, '--edge', '0.05'], '--edge', '0.05', 'take about'),
    ordered('edge is negative', [*OUT, '--edge', '-1'], '--edge', "'-1'", 'greater'),
    ordered('unit that is none', [*OUT, '--unit', 'inch'], '--unit', "'inch'", "'m', 'cm', 'mm'"),
    ordered('output is there', ['-o', '{}/taken'], '{}/taken.msh', 'exists', 'another --output'),
    ordered('output without a name', ['-o', ''], '--output is empty', 'give a name'),
    ordered('output with extension', ['-o', '{}/x.msh'], '--output', 'x.msh', 'an extension'),
]  # fmt: skip

DEVICE = 'max_force: 3.0\nmax_slew: 500.0\nmax_stiffness: 1000.0\n'


def device(kind: str, content: str, *says: str) -> Bad:
    """A file in config/devices."""

    def prepare(folder: Path) -> list[str]:
        (folder / 'config' / 'devices').mkdir(parents=True)
        (folder / 'config' / 'devices' / 'mine.yaml').write_text(content)
        scene = scene_with({'device.profile': 'mine'}, folder)
        return ['demo', '--domain', 'free', '--scene', str(scene)]

    return Bad(f'device: {kind}', prepare, ('{}/config/devices/mine.yaml', *says))


DEVICES = [
    device('figure missing', DEVICE.replace('max_slew: 500.0\n', ''), 'max_slew', 'missing', 'N/s'),
    device('unknown figure', DEVICE + 'max_forse: 2\n', 'max_forse', 'did you mean max_force?'),
    device('force is NaN', DEVICE.replace('3.0', '.nan'), 'max_force', 'nan', '[N]'),
    device('force is negative', DEVICE.replace('3.0', '-3.0'), 'max_force', '-3', '[N]'),
    device('force is a word', DEVICE.replace('3.0', 'strong'), 'max_force', 'strong', '[N]'),
    device('force wrong by 1000', DEVICE.replace('3.0', '3000'), 'max_force', '3000', '[N]'),
    device('short workspace', DEVICE + 'workspace: [0.1]\n', 'workspace', '0.1', '[m]'),
    device('empty', '', 'max_force'),
    device('no YAML', 'max_force: [3\n', 'not valid YAML at column', 'check indentation'),
]


def words(kind: str, line: str, *says: str) -> Bad:
    """A command line; `{}` is the folder, BAG a copy of a sample."""

    def prepare(folder: Path) -> list[str]:
        shutil.copytree(SAMPLE, folder / 'BAG')
        (folder / 'file').touch()
        bag = str(folder / 'BAG')
        return [bag if word == 'BAG' else word.format(folder) for word in line.split()]

    return Bad(f'command: {line}' if not kind else f'command: {kind}', prepare, says)


COMMANDS = [
    words('', 'dmeo', "'dmeo'", "Did you mean 'demo'?", '--help'),
    words('', 'demo --sceen liver', '--sceen', '--scene', '--help'),
    words('', 'demo --seed x', '--seed', "'x'", 'integer'),
    words('', 'demo --seed -1', '--seed', "'-1'", 'greater than or equal to 0'),
    words('', 'demo --seconds 0.1', '--seconds', '0.1', 'from 1 to 86400'),
    words('', 'demo --seconds nan', '--seconds', 'nan', 'from 1 to 86400'),
    words('', 'demo --domain 500', '--domain', '500', 'from 0 to 101'),
    words('', 'demo --bag {}/BAG', '{}/BAG', 'exists already', 'name a new folder'),
    words('', 'record --domain free', '--domain free', 'give the domain of the nodes'),
    words('', 'view --port 70000', '--port', '70000', '65535'),
    words('', 'view --resimulate', '--resimulate', '--bag'),
    words('', 'report', "'bag'", 'missing', '--help'),
    words('', 'report a b', '(b)', 'unexpected', '--help'),
    words('', 'report {}/none', '{}/none', 'not a bag', 'no such folder'),
    words('', 'report {}/file', '{}/file', 'is a file', 'name the folder'),
    words('', 'report BAG -o {}/x.htm', '{}/x.htm', 'end its name in .html'),
    words('', 'picture BAG -o {}/x.bmp', '{}/x.bmp', 'give it an extension of .png'),
    words('', 'picture BAG --at nan', '--at', "'nan'", 'greater'),
    words('', 'picture BAG --at -1', '--at', "'-1'", 'greater'),
    words('', 'picture BAG --at 1000', 'BAG', 'lasts from 0 to', '1000 s'),
    words('', 'export BAG {}/x.vtu --at inf', 'BAG', 'lasts from 0 to', 'inf s'),
    words('', 'replay BAG --as-recorded -o {}/new', '--output', '--as-recorded'),
    words('', 'view --bag BAG --scene pad --seed 3', '--bag', 'leave --scene and --seed out'),
    words('', 'demo --subject a/b', '--subject', "'a/b'", 'pseudonym'),
    words('', 'attempts {} --delete p --exercise pad', '--delete', '--exercise'),
    words('', 'resimulate BAG --with tool.radius=3', 'error: --with tool.radius: ', '[m]'),
    words('', 'picture BAG --at', '--at', 'requires an argument'),
    words('', 'export BAG {}/x.obj', '{}/x.obj', 'a mesh file ends in .vtk'),
    words('', 'export BAG {}/tables --at 1', '--at', 'streams are written as a whole'),
    words('', 'replay BAG --rate nan', '--rate', "'nan'"),
    words('', 'replay BAG --rate=0', '--rate', "'0'", '0.01'),
    words('', 'replay BAG --start 1e4', '--start', '10000', 'lasts'),
    words('', 'resimulate BAG --with toughness', '--with', 'toughness', 'key=value'),
    words('', 'resimulate BAG --with cutting.metod=delete', 'cutting.metod', 'did you mean method'),
    words('', 'resimulate BAG --with tissue.cut_threshold=-1', 'cut_threshold', '-1', '[N]'),
    words('', 'completion fish', "'fish'", "'bash', 'zsh'"),
    words('', 'run', 'name a program', './trainer run python'),
    words('', 'run {}/nothing', '{}/nothing', 'no such file', 'name a program that is there'),
    words('', 'probe-device --profile tuch', 'tuch', 'did you mean touch?'),
    words('', 'bench speed cut --against {}/then.json', '{}/then.json', 'No such file', '--save'),
    words('', 'bench timing --seconds 1', '--seconds', "'1'", 'equal to 5'),
    words('', 'bench fuzz-cuts --method tear', 'tear', 'combined'),
]

EMPTY = "''"
ALL = [*SCENES, *MESHES, *SURFACES, *DEVICES, *COMMANDS]


def test_there_are_more_than_sixty_kinds_and_none_twice() -> None:
    assert len({bad.kind for bad in ALL}) == len(ALL) > 60


def run(arguments: list[str]) -> None:
    if arguments[0] == 'bench':
        cli.run_app(bench, 'trainer bench', arguments[1:])
    cli.main(arguments)


@pytest.mark.parametrize('bad', ALL, ids=lambda bad: bad.kind)
def test_one_sentence_names_file_place_value_and_remedy(
    bad: Bad, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if (arguments := bad.prepare(tmp_path)) and (tmp_path / 'config').exists():
        monkeypatch.setattr(scene_schema, 'share_folder', lambda: tmp_path)
    capfd.readouterr()
    with pytest.raises(SystemExit) as stopped:
        run(arguments)
    said, complaint = capfd.readouterr()
    assert stopped.value.code == Status.BAD_INPUT, said + complaint
    (line,) = complaint.splitlines()
    assert said == '' and line.startswith('error: ')
    for words in bad.says:
        assert words.format(tmp_path) in line, line


@pytest.mark.parametrize(
    ('parameters', 'says'),
    [
        ({'seed': '-1'}, ('seed', '-1', '0 to')),
        ({'seed': 'many'}, ('seed', 'type int')),
        ({'bag': ''}, ('"bag" is missing', 'name the folder')),
        ({'scene': '/nowhere.yaml'}, ('/nowhere.yaml', 'no such file')),
        ({'account_as_json': '3'}, ('account_as_json', 'type bool')),
    ],
)
def test_parameter_of_a_node_that_cannot_be_is_one_sentence_too(
    parameters: dict[str, str],
    says: tuple[str, ...],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = {'bag': str(tmp_path / 'bag')} | parameters
    words = [word for key, value in given.items() for word in ('-p', f'{key}:={value or EMPTY}')]
    monkeypatch.setattr('sys.argv', ['recorder', '--ros-args', *words])
    with pytest.raises(SystemExit) as stopped:
        recorder_node.main()
    assert stopped.value.code == Status.BAD_INPUT
    said, deadline = '', time.monotonic() + 5.0
    while 'error: ' not in said and time.monotonic() < deadline:  # a thread writes it
        said += capfd.readouterr().err
        time.sleep(0.01)
    (line,) = [line for line in said.splitlines() if line.startswith('error: ')]
    assert all(re.search(re.escape(words), line, re.IGNORECASE) for words in says), line
