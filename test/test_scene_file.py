"""A bad scene gives one sentence with file, line, key, value and remedy; a good one is read."""

import functools
import json
import re
from pathlib import Path

import numpy as np
import pytest

from cutting_trainer.exercises.opened_tissue import distance_to_line
from cutting_trainer.exercises.scene_schema import ExerciseSettings
from cutting_trainer.haptic_bridge.emulated_arm.hand import compile_script
from cutting_trainer.haptic_bridge.emulated_arm.scene_schema import ArmSettings
from cutting_trainer.haptic_bridge.scene_schema import (
    DeviceSettings,
    HapticsSettings,
    ToolSettings,
    check_together,
)
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.scene_reader import SECTIONS, TOOLS, SceneModel, read_section
from cutting_trainer.session.scene_loader import SessionSettings
from cutting_trainer.tissue_sim.assembly import load_tissue
from cutting_trainer.tissue_sim.mesh.checks import FACES
from cutting_trainer.tissue_sim.scene_schema import TissueSettings

pytestmark = pytest.mark.long

SCENES = Path(__file__).resolve().parents[1] / 'config' / 'scenes'
TASKS = ('circle', 'excision', 'lumps', 'vessel')
"""Scenes that are an exercise alone: their scripts go to their targets and press nowhere else."""
DEMONSTRATIONS = [path for path in sorted(SCENES.glob('*.yaml')) if path.stem not in TASKS]

GOOD = """\
tissue:
  mesh: organ.msh
  unit: mm
  material: {preset: liver_yi2007, poissons_ratio: 3e-1}
  fixed:
    - below: {axis: z, value: 1e-3}
    - box:
        min: [0, 0, 0]
        max: [0.1, 1, 1]
  integration: {safety: 0.9, max_substeps: 50}
tool: {radius: 0.004}
"""

FIXED = GOOD[GOOD.index('  fixed') : GOOD.index('  integration')]

BAD_EDITS = [
    # what is wrong, text, its replacement, line, and what the sentence must say
    ('unknown section', 'tissue:', 'tisue:', 1, ['tisue', 'did you mean tissue?']),
    ('unknown section, no match', 'tool:', 'qqq:', 11, ['qqq', 'known are tissue']),
    ('section is a number', 'tool: {radius: 0.004}', 'tool: 4', 11, ['tool', 'mapping']),
    ('section is a list', 'tool: {radius: 0.004}', 'tool: [4]', 11, ['tool', 'list', 'mapping']),
    ('unknown key', '  unit:', '  units:', 3, ['tissue.units', 'did you mean unit?']),
    ('unknown key, no match', '  unit:', '  qqq:', 3, ['tissue.qqq', 'known are mesh']),
    ('unknown nested key', 'preset', 'prest', 4, ['tissue.material.prest', 'mean preset?']),
    ('unknown key in a list', 'below', 'bellow', 6, ['tissue.fixed.0.bellow', 'mean below?']),
    ('unknown key is not a word', '  unit: mm', '  7: mm', 3, ['tissue.7', 'known are']),
    ('merge key', '  unit: mm', '  <<: mm', 3, ['tissue.<<', 'not a key']),
    ('key given twice', '  unit: mm', '  mesh: a.msh', 3, ['tissue.mesh', 'twice', 'line 2']),
    ('section given twice', 'tool:', 'tissue:', 11, ['tissue', 'twice', 'line 1']),
    ('key is a list', '  unit: mm', '  [1]: mm', 3, ['list', 'keys are words']),
    ('missing key', '  mesh: organ.msh\n', '', 2, ['tissue', 'mesh is missing', 'meshio']),
    ('missing nested key', 'preset: liver_yi2007, ', '', 4, ['youngs_modulus is missing', 'Pa']),
    ('mesh does not exist', 'organ.msh', 'orgn.msh', 2, ['tissue.mesh', 'did you mean organ.msh']),
    ('folder does not exist', 'organ.msh', 'no/organ.msh', 2, ['tissue.mesh', 'folder']),
    ('mesh is a folder', 'organ.msh', '.', 2, ['tissue.mesh', 'is a folder']),
    ('mesh is a number', 'organ.msh', '3', 2, ['tissue.mesh', '3', 'string']),
    ('unknown choice', 'unit: mm', 'unit: inch', 3, ["'inch'", "'m', 'cm' or 'mm'"]),
    ('unknown preset', 'liver_yi2007', 'spleen', 4, ["'spleen'", "'liver_elastography'"]),
    ('too large', '3e-1', '0.5', 4, ['poissons_ratio', '0.5', 'less than 0.5']),
    ('negative', '3e-1', '-0.1', 4, ['poissons_ratio', '-0.1', 'greater than or equal to 0']),
    ('negative modulus', '3e-1', '0.3, youngs_modulus: -5', 4, ['youngs_modulus', '-5', '[Pa]']),
    ('modulus in kPa', '3e-1', '0.3, youngs_modulus: 5.4', 4, ['youngs_modulus', '5.4', '[Pa]']),
    ('all shear relaxes', '3e-1', '0.3, prony: [[0.6, 1], [0.5, 2]]', 4, ['prony', '1.1', '0.95']),
    ('time in ms', '3e-1', '0.3, prony: [[0.6, 0.001]]', 4, ['prony.0.1', '0.001', '[s]']),
    ('three terms', '3e-1', '0.3, prony: [[0.1, 1], [0.1, 2], [0.1, 3]]', 4, ['prony', 'two']),
    ('a term without time', '3e-1', '0.3, prony: [[0.1]]', 4, ['prony.0', 'tau']),
    ('gravity in g', '  unit: mm', '  gravity: [0, 0, -981]', 3, ['gravity', '-981', '[m/s^2]']),
    ('gravity as a number', '  unit: mm', '  gravity: -9.81', 3, ['gravity', '-9.81', '[m/s^2]']),
    ('density in g/cm^3', '3e-1', '0.3, density: 1.05', 4, ['density', '1.05', '[kg/m^3]']),
    ('NaN', '3e-1', '.nan', 4, ['poissons_ratio', 'NaN', 'finite']),
    ('infinite', '3e-1', '.inf', 4, ['poissons_ratio', 'Infinity', 'finite']),
    ('word for a number', '3e-1', 'yes', 4, ['poissons_ratio', "'yes'", 'number']),
    ('number in quotes', '3e-1', "'0.3'", 4, ['poissons_ratio', "'0.3'", 'number']),
    ('truth for a number', '3e-1', 'true', 4, ['poissons_ratio', 'true', 'number']),
    ('list for a number', '3e-1', '[0.3]', 4, ['poissons_ratio', '[0.3]', 'number']),
    ('nothing for a number', '3e-1', 'null', 4, ['poissons_ratio', 'null', 'number']),
    ('fraction for a count', 'max_substeps: 50', 'max_substeps: 2.5', 10, ['2.5', 'integer']),
    (
        'zero safety',
        'safety: 0.9',
        'safety: 0',
        10,
        ['integration.safety', '0', 'greater than or equal to 0.01'],
    ),
    ('item among keys', '- below: {axis: z, value: 1e-3}', 'a: 1', 7, ['YAML', 'indentation']),
    ('mapping for a list', FIXED, '  fixed: {below: {}}\n', 5, ['tissue.fixed', 'array']),
    ('empty list', FIXED, '  fixed: []\n', 5, ['tissue.fixed', 'at least 1', 'regions']),
    ('word for a mapping', '{axis: z, value: 1e-3}', 'z', 6, ['fixed.0.below', "'z'", 'axis']),
    ('short point', '[0, 0, 0]', '[0, 0]', 8, ['fixed.1.box.min', '[0, 0]', 'corner']),
    ('long point', '[0, 0, 0]', '[0, 0, 0, 0]', 8, ['fixed.1.box.min', 'at most 3']),
    ('word in a point', '[0, 0, 0]', '[0, 0, a]', 8, ['fixed.1.box.min.2', "'a'", 'number']),
    ('point in mm', '[0, 0, 0]', '[-40, 0, 0]', 8, ['fixed.1.box.min.0', '-40', '[m]']),
    ('box turned round', '[0, 0, 0]', '[0.2, 0, 0]', 7, ['fixed.1.box', '0.2', 'exchange']),
    ('unknown axis', 'axis: z', 'axis: w', 6, ['fixed.0.below.axis', "'w'", "'x', 'y' or 'z'"]),
    ('two regions in one', '    - box', '      box', 6, ['fixed.0', 'one of box', 'below']),
    ('bracket left open', '[0, 0, 0]', '[0, 0, 0', 9, ['YAML', 'brackets']),
    ('brace left open', 'value: 1e-3}', 'value: 1e-3', 7, ['YAML', 'brackets']),
    ('bad indentation', '  unit', '   unit', 3, ['YAML', 'indentation']),
    ('tabulator', '  unit', '\tunit', 3, ['YAML', 'indentation']),
    ('two documents', 'tool:', '---\ntool:', 11, ['YAML', 'single document']),
    ('undefined alias', '3e-1', '*nu', 4, ['YAML', 'alias']),
    ('alias of itself', '[0, 0, 0]', '&a [*a]', 8, ['fixed.1.box.min', 'contains itself']),
    ('foreign tag', '3e-1', '!!python/name:os.system 1', 4, ['poissons_ratio', 'tag']),
    ('tag that does not fit', '3e-1', '!!float x', 4, ['poissons_ratio', "'x'", 'tag']),
]


def write(folder: Path, text: str) -> Path:
    (folder / 'organ.msh').touch()
    scene = folder / 'scene.yaml'
    scene.write_text(text, encoding='utf-8')
    return scene


def sentence(scene: Path) -> str:
    with pytest.raises(SceneError) as caught:
        read_section(scene, 'tissue', TissueSettings)
    message = str(caught.value)
    assert '\n' not in message
    assert str(scene) in message
    return message


def test_a_good_scene_is_read_with_paths_relative_to_it(tmp_path):
    settings = read_section(write(tmp_path, GOOD), 'tissue', TissueSettings)
    assert settings.mesh == tmp_path / 'organ.msh'
    assert settings.unit_scale == 1e-3
    assert settings.material.youngs_modulus == 642.55
    assert settings.material.poissons_ratio == 0.3
    assert settings.fixed[1].box.max == (0.1, 1.0, 1.0)
    assert settings.integration.rate == 30
    assert settings.material.prony == () and settings.gravity == (0.0, 0.0, 0.0)
    text = GOOD.replace('3e-1', '3e-1, prony: [[0.3, 0.1], [0.2, 1]]')
    viscous = read_section(write(tmp_path, text), 'tissue', TissueSettings)
    assert viscous.material.prony == ((0.3, 0.1), (0.2, 1.0))


@pytest.mark.parametrize(
    ('old', 'new', 'line', 'parts'),
    [edit[1:] for edit in BAD_EDITS],
    ids=[edit[0] for edit in BAD_EDITS],
)
def test_a_bad_scene_gives_one_sentence_with_file_line_key_and_remedy(
    tmp_path, old, new, line, parts
):
    assert old in GOOD
    message = sentence(write(tmp_path, GOOD.replace(old, new, 1)))
    assert message.startswith(f'{tmp_path / "scene.yaml"}:{line}: ')
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ('text', 'parts'),
    [
        ('', ['empty', 'sections']),
        ('# nothing but a comment\n', ['empty', 'sections']),
        ('- tissue\n', ['list', 'sections']),
        ('tissue\n', ['single value', 'sections']),
        ('tool: {radius: 0.004}\n', ['tissue is missing', 'mesh, material, fixed']),
        ('tissue:\n', ['tissue is missing', 'mesh, material, fixed']),
        ('tissue: \x01\n', ['YAML', 'plain text']),
    ],
)
def test_a_scene_without_content_says_what_a_scene_has(tmp_path, text, parts):
    message = sentence(write(tmp_path, text))
    for part in parts:
        assert part in message


def test_a_binary_file_is_not_a_scene(tmp_path):
    scene = tmp_path / 'scene.yaml'
    scene.write_bytes(b'tissue: \xff\xfe')
    assert 'UTF-8' in sentence(scene)


def test_a_missing_scene_names_its_nearest_neighbour(tmp_path):
    write(tmp_path, GOOD)
    assert 'did you mean scene.yaml?' in sentence(tmp_path / 'scne.yaml')
    assert 'folder' in sentence(tmp_path / 'nowhere' / 'scene.yaml')
    assert 'is a folder' in sentence(tmp_path)


def test_a_missing_section_means_the_defaults(tmp_path):
    class Optional(SceneModel):
        strength: float = 2.0

    for text in (GOOD, GOOD + 'cutting:\n'):
        assert read_section(write(tmp_path, text), 'cutting', Optional).strength == 2.0


@pytest.mark.parametrize('scene', sorted(SCENES.glob('*.yaml')), ids=lambda path: path.stem)
def test_a_shipped_scene_is_complete_and_valid(scene):
    keys = re.findall(r'^(\w+):', scene.read_text(encoding='utf-8'), flags=re.MULTILINE)
    assert {*keys, 'exercise'} - {TOOLS} == set(SECTIONS)  # which a scene may lack
    tissue = read_section(scene, 'tissue', TissueSettings)
    tool = read_section(scene, 'tool', ToolSettings)
    device = read_section(scene, 'device', DeviceSettings)
    haptics = read_section(scene, 'haptics', HapticsSettings)
    arm = read_section(scene, 'arm', ArmSettings)
    check_together(tool, device, haptics, device.load_profile())
    seconds = read_section(scene, 'session', SessionSettings).seconds
    assert compile_script(arm.script, device.tissue_from_device).seconds == pytest.approx(seconds)
    _, _, fixed, _ = load_tissue(tissue)
    assert 10 < fixed.sum() <= len(fixed) / 2


@functools.cache
def corners(scene: Path) -> tuple[np.ndarray, ...]:
    """Corners of all faces of the scene's tissue [m], each shape (n, 3)."""
    nodes, tetrahedra, *_ = load_tissue(read_section(scene, 'tissue', TissueSettings))
    return tuple(np.moveaxis(nodes[tetrahedra[:, FACES].reshape(-1, 3)], 1, 0))


def height(scene: Path, x: float, y: float) -> float:
    """Largest z [m] of the scene's tissue above (x, y); minus infinity beside it."""
    a, b, c = corners(scene)
    double = _cross(b - a, c - a)
    upright = np.abs(double) > 1e-12
    point = np.array([x, y, 0])
    v = _cross(point - a, c - a)[upright] / double[upright]
    w = _cross(b - a, point - a)[upright] / double[upright]
    z = (1 - v - w) * a[upright, 2] + v * b[upright, 2] + w * c[upright, 2]
    return float(z[(v >= 0) & (w >= 0) & (v + w <= 1)].max(initial=-np.inf))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


@pytest.mark.parametrize('scene', DEMONSTRATIONS, ids=lambda path: path.stem)
def test_a_shipped_script_starts_free_presses_three_places_and_cuts_inside_if_at_all(scene):
    tool = read_section(scene, 'tool', ToolSettings)
    script = read_section(scene, 'arm', ArmSettings).script
    positions = [(phase.kind, [w.position for w in phase.waypoints]) for phase in script.phases]

    def depth(p):
        return height(scene, p[0], p[1]) + tool.radius - p[2]

    assert depth(script.start.position) < -0.02
    palpated = [p for kind, points in positions if kind == 'palpate' for p in points]
    pressed = [depth(p) for p in palpated if depth(p) > 0]
    assert len(pressed) == 3
    assert pressed == sorted(pressed)
    strokes = [points for kind, points in positions if kind == 'cut']
    assert bool(strokes) == read_section(scene, 'tissue', TissueSettings).budget.cuts
    for first, *drawn in strokes:
        assert depth(first) > max(pressed) + 0.003
        inside = [p for p in drawn if depth(p) > 0]
        ends = [height(scene, p[0], p[1]) - p[2] - tool.blade_tip[2] for p in inside]
        assert min(ends) > 0.003
        assert max(ends) < 0.015
        assert np.linalg.norm(np.diff(inside, axis=0), axis=1).sum() >= 0.03
    assert depth(positions[-1][1][-1]) < -0.02


@pytest.mark.parametrize('name', TASKS)
def test_a_script_of_a_task_starts_and_ends_free_and_goes_to_what_it_must_open_or_mark(name):
    scene = SCENES / f'{name}.yaml'
    tool = read_section(scene, 'tool', ToolSettings)
    script = read_section(scene, 'arm', ArmSettings).script
    task = read_section(scene, 'exercise', ExerciseSettings)

    def depth(p):
        return height(scene, p[0], p[1]) + tool.radius - p[2]

    places = [w.position for phase in script.phases for w in phase.waypoints]
    for end in (script.start.position, places[-1]):
        assert depth(end) < -0.015
    in_tissue = np.array([p for p in places if depth(p) > 0])
    for lump in task.lumps:
        off = np.linalg.norm(in_tissue[:, :2] - lump.centre[:2], axis=1)
        assert off.min() < lump.radius
    for target in task.targets:
        corners = target.corners()
        # Seen from above, the way is the target in the stretched tissue, to a tenth of its margin.
        corners *= 1 + np.array(read_section(scene, 'tissue', TissueSettings).stretch)
        assert distance_to_line(corners[:, :2], in_tissue[:, :2]).max() < 0.1 * target.margin
        ends = corners[0, 2] - in_tissue[:, 2] - tool.blade_tip[2]
        assert ends.max() > target.depth[0]


def test_settings_name_range_and_unit_of_every_number():
    schema = json.dumps(TissueSettings.model_json_schema())
    numbers = re.findall(r'\{[^{}]*"type": "(?:number|integer)"[^{}]*\}', schema)
    described = [n for n in numbers if '"description"' in n]
    assert len(described) > 10
    for number in described:
        assert re.search(r'\[[^]]+\]', number), number
        assert 'imum"' in number.replace('exclusiveMaximum', 'maximum').replace(
            'exclusiveMinimum', 'minimum'
        )
