"""The interface for programs: what docs/python.md shows runs, and the import alone is cheap."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import cutting_trainer

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


@pytest.mark.parametrize('name', cutting_trainer.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(cutting_trainer, name).__name__ == name


def test_import_of_the_package_alone_loads_no_room() -> None:
    loaded = run('import cutting_trainer, sys; print(*sys.modules)').split()
    assert not [name for name in loaded if name.startswith(('cutting_trainer.', 'numpy', 'numba'))]


def test_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match='nothing'):
        cutting_trainer.nothing  # noqa: B018
