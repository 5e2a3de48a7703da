"""An organ of one's own: what a surface may be, what is mended, what comes out of it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bench.common.meshes import kuhn_block
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.haptic_bridge.emulated_arm.hand import compile_script
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.mesh_import import mesher
from cutting_trainer.mesh_import.import_mesh import SIDES, ImportOptions, import_mesh
from cutting_trainer.mesh_import.imported_scene import height
from cutting_trainer.mesh_import.surface_import import read_surface
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.in_process import InProcess, Tissue
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.tool import ContactState

pytestmark = pytest.mark.long

BODY = trimesh.creation.icosphere(subdivisions=3, radius=30.0)
BODY.apply_scale([1.3, 1.0, 0.6])
"""[mm], rounded like an organ, 78 x 60 x 36."""


def without(*triangles: int) -> trimesh.Trimesh:
    kept = np.ones(len(BODY.faces), bool)
    kept[list(triangles)] = False
    mesh = BODY.copy()
    mesh.update_faces(kept)
    return mesh


def with_faces(faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(BODY.vertices, faces, process=False)


def turned(count: int) -> trimesh.Trimesh:
    faces = BODY.faces.copy()
    faces[:count] = faces[:count, ::-1]
    return with_faces(faces)


def saved(folder: Path, mesh: trimesh.Trimesh, name: str = 'organ.stl') -> Path:
    mesh.export(folder / name)
    return folder / name


@pytest.mark.parametrize('name', ['organ.stl', 'organ.ply', 'organ.obj'])
def test_closed_surface_is_taken_as_it_is(tmp_path: Path, name: str) -> None:
    surface = read_surface(saved(tmp_path, BODY, name), 'mm')
    assert surface.mended == ()
    assert surface.parts == 1
    assert surface.volume == pytest.approx(BODY.volume * 1e-9, rel=1e-5)
    assert surface.size == pytest.approx([0.078, 0.060, 0.036], rel=1e-2)


@pytest.mark.parametrize(
    ('mesh', 'named'),
    [
        (without(17), 'holes'),
        (turned(len(BODY.faces)), 'the whole surface'),
        (turned(40), '40 triangles that faced inward'),
        (with_faces(np.vstack((BODY.faces, BODY.faces[:5]))), '5 triangles, flat or double'),
    ],
    ids=['missing triangle', 'inside out', 'some inside out', 'double'],
)
def test_defect_with_one_answer_is_mended_and_named(
    tmp_path: Path, mesh: trimesh.Trimesh, named: str
) -> None:
    surface = read_surface(saved(tmp_path, mesh, 'organ.ply'), 'mm')
    (sentence,) = surface.mended
    assert named in sentence
    again = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    assert again.is_watertight and again.is_winding_consistent
    assert again.volume == pytest.approx(BODY.volume * 1e-9, rel=2e-3)


def shells(inner: float, shift: float, *, turn: bool) -> trimesh.Trimesh:
    """The body and a smaller one, inside it or beside it; the smaller one perhaps turned."""
    small = BODY.copy()
    small.apply_scale(inner)
    small.apply_translation([shift, 0, 0])
    if turn:
        small.invert()
    return trimesh.util.concatenate([BODY, small])


@pytest.mark.parametrize('turn', [False, True])
@pytest.mark.parametrize(('shift', 'sign'), [(0.0, -1), (100.0, 1)])
def test_inner_shell_is_a_cavity_and_one_beside_it_another_part_however_they_are_turned(
    tmp_path: Path, turn: bool, shift: float, sign: int
) -> None:
    surface = read_surface(saved(tmp_path, shells(0.5, shift, turn=turn)), 'mm')
    assert surface.parts == 2
    assert surface.volume == pytest.approx(BODY.volume * 1e-9 * (1 + sign * 0.125), rel=1e-5)
    assert bool(surface.mended) == (turn == (sign > 0))


def klein_bottle() -> trimesh.Trimesh:
    """A closed surface with one side."""
    u, v = np.meshgrid(np.arange(24), np.arange(12), indexing='ij')
    a, b = u * 2 * np.pi / 24, (v + 0.5) * 2 * np.pi / 12
    r = 20 + 8 * (np.cos(a / 2) * np.sin(b) - np.sin(a / 2) * np.sin(2 * b))
    z = 8 * (np.sin(a / 2) * np.sin(b) + np.cos(a / 2) * np.sin(2 * b))
    vertices = np.stack([r * np.cos(a), r * np.sin(a), z], axis=-1).reshape(-1, 3)

    def index(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        wrapped = np.where(i == 24, -j - 1, j) % 12  # glued with a flip
        return (i % 24) * 12 + wrapped

    p, q = index(u, v), index(u + 1, v)
    s, t = index(u, v + 1), index(u + 1, v + 1)
    faces = np.concatenate(
        [np.stack([p, q, t], -1).reshape(-1, 3), np.stack([p, t, s], -1).reshape(-1, 3)]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


FLAT = trimesh.Trimesh([[0, 0, 0], [40, 0, 0], [0, 40, 0]], [[0, 1, 2], [0, 2, 1]], process=False)


@pytest.mark.parametrize(
    ('mesh', 'unit', 'named'),
    [
        (without(*range(60)), 'mm', ['not closed', 'edges without two', 'Close Holes']),
        (BODY, 'm', ['78 m long', 'cm or mm', '--unit']),
        (trimesh.creation.icosphere(radius=1e-5), 'm', ['2e-05 m long', 'scale it']),
        (klein_bottle(), 'mm', ['no inside and outside']),
        (FLAT, 'mm', ['not closed', '3 edges']),
    ],
    ids=['open', 'unit', 'tiny', 'one-sided', 'flat'],
)
def test_surface_that_cannot_be_filled_is_refused_in_one_sentence_with_a_remedy(
    tmp_path: Path, mesh: trimesh.Trimesh, unit: str, named: list[str]
) -> None:
    path = saved(tmp_path, mesh, 'organ.ply')
    with pytest.raises(SessionError) as refused:
        read_surface(path, unit)
    said = str(refused.value)
    assert said.startswith(str(path)) and '\n' not in said and ': ' in said
    assert all(name in said for name in named), said


def nan() -> bytes:
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, np.nan]], [[0, 1, 2]], process=False)
    return bytes(mesh.export(file_type='ply'))


@pytest.mark.parametrize(
    ('name', 'content', 'named'),
    [
        ('organ.stl', b'', 'is empty'),
        ('organ.stl', b'not a surface at all', 'organ.stl'),
        ('organ.qqq', b'abc', 'STL, PLY or OBJ'),
        ('organ.obj', b'v 0 0 0\nv 1 0 0\nv 0 1 0\n', 'organ.obj'),
        ('organ.ply', nan(), 'not numbers'),
    ],
)
def test_file_without_a_surface_is_refused_in_one_sentence(
    tmp_path: Path, name: str, content: bytes, named: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SessionError, match=named) as refused:
        read_surface(tmp_path / name, 'mm')
    assert '\n' not in str(refused.value)


def test_missing_file_and_huge_surface_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path, BODY)
    with pytest.raises(SessionError, match=r'did you mean organ\.stl'):
        read_surface(tmp_path / 'orgn.stl', 'mm')
    monkeypatch.setattr('cutting_trainer.mesh_import.surface_import.MAX_TRIANGLES', 100)
    with pytest.raises(SessionError, match='simplify it'):
        read_surface(path, 'mm')


def options(surface: Path, output: Path, **others: object) -> ImportOptions:
    given = {'unit': 'mm', 'edge': 0.009, 'rests_on': '-z', 'as_json': True} | others
    return ImportOptions(surface, output, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ('others', 'named'),
    [
        ({'edge': 1e-4}, 'tetrahedra, more than'),
        ({'edge': 0.5}, 'more than half of the size'),
        ({'rests_on': 'down'}, '--rests-on down: one of -z'),
    ],
)
def test_request_that_makes_no_mesh_is_refused_with_what_would(
    tmp_path: Path, others: dict[str, object], named: str
) -> None:
    with pytest.raises(SessionError, match=named):
        import_mesh(options(saved(tmp_path, BODY), tmp_path / 'made', **others))
    assert not list(tmp_path.glob('made*'))


def test_without_the_mesher_it_is_said_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesher, 'find_spec', lambda name: None)
    with pytest.raises(SessionError, match=r'pip install -r requirements-mesh\.txt'):
        import_mesh(options(saved(tmp_path, BODY), tmp_path / 'made'))


def test_an_organ_of_the_wrong_unit_is_asked_about(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = saved(tmp_path, BODY)
    import_mesh(options(path, tmp_path / 'made', unit='cm', edge=0.1))
    (warning,) = json.loads(capsys.readouterr().out)['warnings']
    assert '0.78 m long' in warning and '--unit' in warning


def test_mesher_that_dies_is_an_error_and_not_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: object, **__: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess([], -6, '', 'terminate called\nout of cheese\n')

    monkeypatch.setattr(subprocess, 'run', die)
    with pytest.raises(SessionError, match='out of cheese; try another --edge'):
        mesher.fill(BODY.vertices * 1e-3, BODY.faces, 0.009, 0.001)


def test_mesh_is_numbered_so_that_neighbours_lie_near_one_another() -> None:
    mesh, random = kuhn_block((12, 12, 12), (0.1, 0.1, 0.1)), np.random.default_rng(0)
    n, order = mesh.node_count, random.permutation(mesh.node_count)
    shuffled = random.permutation(np.argsort(order)[mesh.tetrahedra].astype(np.int32))
    nodes, tetrahedra = mesher.reorder_nodes(mesh.rest[order], shuffled)
    assert np.array_equal(np.unique(nodes, axis=0), np.unique(mesh.rest, axis=0))
    before, after = mesh.rest[order][shuffled], nodes[tetrahedra]
    ours, theirs = after.mean(axis=1), before.mean(axis=1)  # no two are alike
    same = np.lexsort(ours.T), np.lexsort(theirs.T)
    assert np.array_equal(after[same[0]], before[same[1]])
    assert np.ptp(shuffled, axis=1).max() > 0.9 * n
    assert np.ptp(tetrahedra, axis=1).max() < 4 * 13**2  # of 13^3: some layers
    assert (np.diff(tetrahedra.min(axis=1)) >= 0).all()


@pytest.fixture(scope='module')
def imported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """A body imported, resting on its side +x; the scene and the report."""
    folder = tmp_path_factory.mktemp('organ')
    surface = saved(folder, without(17))
    command = [
        sys.executable,
        '-m',
        'cutting_trainer.cli.main',
        'import-mesh',
        str(surface),
        '--json',
    ]
    command += ['--edge', '0.009', '-o', str(folder / 'mine #2')]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == Status.OK, done.stderr
    assert {path.suffix for path in folder.iterdir()} == {'.stl', '.msh', '.yaml'}
    assert len([*folder.iterdir()]) == 3  # nothing of the mesher's own
    return folder / 'mine #2.yaml', json.loads(done.stdout)


def test_surface_that_crosses_itself_is_refused_with_the_place_and_nothing_is_written(
    tmp_path: Path,
) -> None:
    mesh = BODY.copy()
    top = mesh.vertices[:, 2] > 16.0
    mesh.vertices[top] -= [0.0, 0.0, 48.0]  # through the underside
    options = ImportOptions(
        saved(tmp_path, mesh), tmp_path / 'mine', 'mm', 0.009, '-z', as_json=True
    )
    with pytest.raises(SessionError, match=r'mm from the surface, near .*crosses itself there'):
        import_mesh(options)
    assert {path.name for path in tmp_path.iterdir()} == {'organ.stl'}


def test_imported_mesh_is_the_body_and_the_report_says_how_good_it_is(
    imported: tuple[Path, dict[str, object]],
) -> None:
    path, report = imported
    mesh = make_simulation(load_scene(str(path)).tissue)[0].mesh
    assert report['tetrahedra'] == len(mesh.tetrahedra) > 200
    assert mesh.volumes().min() == pytest.approx(report['least_volume'])
    assert mesh.volumes().sum() == pytest.approx(BODY.volume * 1e-9, rel=0.1)
    assert 0 < report['surface_moved'] < 0.5 * 0.009  # type: ignore[operator]
    assert 0 < report['radius_ratio_least'] <= report['radius_ratio_median'] < 1  # type: ignore[operator]
    assert any('holes' in sentence for sentence in report['mended'])  # type: ignore[attr-defined]
    assert mesh.rest[:, 2].min() == 0.0
    assert np.ptp(mesh.rest, axis=0) == pytest.approx([0.078, 0.060, 0.036], rel=0.06)
    held = mesh.rest[mesh.fixed == 1, 2]
    assert 6 <= len(held) < len(mesh.rest) / 4
    assert held.max() < mesh.rest[mesh.fixed == 0, 2].min() + 1e-12


def test_imported_scene_is_pressed_and_cut_by_its_own_script(
    imported: tuple[Path, dict[str, object]],
) -> None:
    scene = load_scene(str(imported[0]))
    tissue = Tissue(make_simulation(scene.tissue)[0], make_method(scene.cutting))
    session = InProcess(
        ForcePath(scene.tool, scene.device, scene.haptics, scene.profile), tissue, 30.0
    )
    script = compile_script(scene.arm.script, scene.device.tissue_from_device)
    before = len(tissue.simulation.mesh.tetrahedra)
    forces, entered = [], 0
    for tick in range(int(1000 * script.seconds)):
        position = np.array(
            [np.interp(tick / 1000, script.times, script.positions[:, axis]) for axis in range(3)]
        )
        session.tick(position)
        forces.append(session.path.force_norm)
        if tissue.simulation.state == ContactState.INSIDE and not entered:
            entered = tick
        assert session.frame is None or not session.frame.diverged
    cut = tissue.simulation.mesh.triangle_kind.sum()
    assert max(forces[:500]) == 0.0  # it starts above the organ
    assert max(forces[2000:6000]) > 0.02  # it palpates,
    assert entered > 7500  # and the blade goes in where it is to cut
    assert 0.1 < max(forces) < scene.profile.max_force
    assert forces[-1] == 0.0
    assert cut > 0
    assert len(tissue.simulation.mesh.tetrahedra) != before


@pytest.mark.parametrize('side', SIDES)
def test_side_on_which_it_rests_is_turned_down_without_mirroring(side: str) -> None:
    from cutting_trainer.mesh_import.import_mesh import _placed

    box = trimesh.creation.box([0.04, 0.05, 0.06])
    axis, sign = SIDES[side]
    # a dent in the middle of the side that is to be down
    tip = np.zeros(3)
    tip[axis] = -sign * 0.02
    vertices = np.vstack((box.vertices, tip))
    placed = _placed(vertices, side)
    solid = trimesh.Trimesh(placed[:8], box.faces, process=False)
    assert solid.volume == pytest.approx(box.volume)
    assert placed[:, 2].min() == 0.0
    size = [0.04, 0.05, 0.06]
    assert placed[8, 2] == pytest.approx(size[axis] / 2 - 0.02)


def test_height_is_that_of_the_solid_over_a_place() -> None:
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    tetrahedra = np.array([[0, 1, 2, 3]], np.int32)
    assert height(nodes, tetrahedra, np.array([0.25, 0.25])) == pytest.approx(0.5)
    assert height(nodes, tetrahedra, np.array([0.8, 0.8])) == -np.inf


def test_output_that_exists_is_not_overwritten(tmp_path: Path) -> None:
    surface = saved(tmp_path, BODY)
    (tmp_path / 'made.yaml').write_text('mine')
    with pytest.raises(SessionError, match='exists'):
        import_mesh(options(surface, tmp_path / 'made'))
    with pytest.raises(SessionError, match='without an extension'):
        import_mesh(options(surface, tmp_path / 'made.msh'))
