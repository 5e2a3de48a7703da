"""Rooms import downward only, and nothing of the product imports what only measures it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = (
    ('node_common',),
    ('tissue_sim.mesh',),
    ('tissue_sim.contact',),
    ('tissue_sim.elasticity',),
    ('tissue_sim.motion',),
    ('tissue_sim.simulation',),
    ('tissue_sim.planner', 'tissue_sim.streaming'),
    ('tissue_sim',),
    ('haptic_bridge', 'cutting'),
    ('bags',),
    ('exercises',),
    ('viewer',),
    ('session',),
    ('recordings', 'mesh_import'),
    ('studies',),
    ('cli', '__init__'),  # for people, and for their programs: cutting_trainer/__init__.py
    ('bench',),
)
"""Rooms by floor: one imports from itself and from the floors below."""
FLOORS = {room: floor for floor, rooms in enumerate(LAYERS) for room in rooms}
FOLDERS = sorted({room.partition('.')[0] for room in FLOORS} - {'__init__'} | {'cutting_trainer'})


def room_of(name: str) -> str | None:
    """Room of a module, by its full name; None: it is not ours."""
    first, _, rest = name.partition('.')
    words = (rest if first == 'cutting_trainer' and rest else name).split('.')
    return next((r for r in ('.'.join(words[:2]), words[0]) if r in FLOORS), None)


def breaches(module: str, code: str) -> Iterator[str]:
    """Imports that go upward, or across to another room of the same floor."""
    here = room_of(module)
    assert here is not None, f'{module} is in no room of this table'
    for node in ast.walk(ast.parse(code)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{module}:{node.lineno}: a relative import'
            names = [f'{node.module}.{alias.name}' for alias in node.names]
        for name in names:
            there = room_of(name)
            if there not in (None, here) and FLOORS[there] >= FLOORS[here]:
                yield f'{module}:{node.lineno} imports {name}'


@pytest.mark.parametrize('folder', FOLDERS)
def test_every_room_imports_only_from_rooms_below_it(folder: str) -> None:
    paths = sorted((ROOT / folder).glob('*.py' if folder == 'cutting_trainer' else '**/*.py'))
    assert paths
    modules = {'.'.join(p.relative_to(ROOT).with_suffix('').parts): p for p in paths}
    found = [
        breach for name, path in modules.items() for breach in breaches(name, path.read_text())
    ]
    assert not found


@pytest.mark.parametrize(
    ('module', 'code'),
    [
        ('tissue_sim.mesh.files', 'from cutting_trainer.tissue_sim.scene_schema import Material'),
        ('node_common.ros', 'import cutting_trainer.tissue_sim.mesh.replica'),
        ('haptic_bridge.node', 'from cutting_trainer.cutting import method_registry'),
        ('cutting.node', 'from cutting_trainer import haptic_bridge'),
        ('cli.main', 'def late():\n    from bench.speed import command'),
    ],
)
def test_import_that_goes_upward_or_across_is_found(module: str, code: str) -> None:
    assert list(breaches(module, code))


def test_every_folder_with_modules_has_its_place() -> None:
    folders = {path.parent.name for path in ROOT.glob('*/__init__.py')}
    assert folders == set(FOLDERS)
    parts = {f'tissue_sim.{path.parent.name}' for path in ROOT.glob('tissue_sim/*/__init__.py')}
    assert parts == {room for room in FLOORS if room.startswith('tissue_sim.')}
