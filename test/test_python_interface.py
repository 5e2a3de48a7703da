"""The interface for programs: what docs/python.md shows runs, and the import alone is cheap."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cutting_trainer
from cutting_trainer.node_common.errors import MeshError

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = re.findall(r'```python\n(.*?)```', (ROOT / 'docs' / 'python.md').read_text(), re.S)


def run(code: str) -> str:
    return subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.long
def test_a_scene_gives_a_force_against_the_press_and_a_cut() -> None:
    said = run(EXAMPLES[0])
    assert float(said.splitlines()[0].split()[-1]) > 0.01
    assert int(said.split()[-1]) > 0


@pytest.mark.long
def test_a_mesh_and_a_material_give_a_force_against_the_press() -> None:
    said = run(EXAMPLES[1])
    assert float(re.search(r'\[ *\S+ +\S+ +(\S+)\] substeps', said)[1]) > 0.01


NODES, TETRAHEDRA = np.vstack((np.zeros(3), np.eye(3))), np.array([[0, 1, 2, 3]])


@pytest.mark.parametrize(
    ('rest', 'tetrahedra', 'fixed', 'says'),
    [
        (NODES[:, :2], TETRAHEDRA, None, 'rest positions have the shape (4, 2)'),
        (NODES * np.nan, TETRAHEDRA, None, 'finite'),
        (NODES, TETRAHEDRA[:, :3], None, 'tetrahedra have the shape (1, 3)'),
        (NODES, TETRAHEDRA * np.nan, None, 'the type float64: integers'),
        (NODES, TETRAHEDRA + 1, None, 'tetrahedron 0 has nodes [1, 2, 3, 4]: the mesh has 4'),
        (NODES, TETRAHEDRA - 1, None, 'tetrahedron 0 has nodes [-1, 0, 1, 2]'),
        (NODES, TETRAHEDRA, np.array([0, 1]), 'fixed has the shape (2,)'),
    ],
)
def test_arrays_that_are_no_mesh_are_refused(rest, tetrahedra, fixed, says) -> None:
    with pytest.raises(MeshError, match=re.escape(says)):
        cutting_trainer.TetMesh(rest, tetrahedra, fixed)


@pytest.mark.parametrize('constants', [(-1.0, 0.4, 1e3), (5e3, 0.5, 1e3), (5e3, 0.4, np.nan)])
def test_constants_of_no_tissue_are_refused(constants) -> None:
    with pytest.raises(ValueError, match='must be'):
        cutting_trainer.Material(*constants)


def test_a_model_that_is_not_there_is_refused_with_those_that_are() -> None:
    mesh, material = (
        cutting_trainer.TetMesh(NODES, TETRAHEDRA),
        cutting_trainer.Material(5e3, 0.4, 1e3),
    )
    resistance = cutting_trainer.Resistance(1.0, 100.0, 1.0)
    with pytest.raises(ValueError, match=r"no model 'foo'.*linear_smoothed"):
        cutting_trainer.TissueSimulation(mesh, material, resistance, model='foo')


@pytest.mark.parametrize('name', cutting_trainer.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(cutting_trainer, name).__name__ == name


def test_import_of_the_package_alone_loads_no_room() -> None:
    loaded = run('import cutting_trainer, sys; print(*sys.modules)').split()
    assert not [name for name in loaded if name.startswith(('cutting_trainer.', 'numpy', 'numba'))]


def test_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match='nothing'):
        cutting_trainer.nothing  # noqa: B018
