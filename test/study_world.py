"""Study files, bags and rows for the tests of studies."""

from pathlib import Path

import numpy as np

from cutting_trainer.studies.bag_collection import StudyBag
from cutting_trainer.studies.description import Study, read_study
from cutting_trainer.studies.designs import RECORDED, Setting
from cutting_trainer.studies.evaluation import Result
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.outputs import FIGURES
from cutting_trainer.studies.table import Row

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
GOOD = """\
bags: [bags]
settings:
  grid:
    tissue.material.toughness: [100, 200]
    cutting.method: [combined, delete]
  latin_hypercube:
    samples: 5
    ranges:
      tissue.material.toughness: {low: 50, high: 400, scale: log}
outputs: [largest_force]
"""


def designed(designs: dict[str, object]) -> Study:
    return Study.model_validate({'bags': ['bags'], 'settings': designs})


def study(tmp_path: Path, text: str) -> Study:
    file = tmp_path / 'study.yaml'
    file.write_text(text)
    return read_study(file)


def result(force: float, failure: str = '') -> Result:
    values = dict.fromkeys(FIGURES, 0.0) | {'largest_force': force}
    return Result({} if failure else values, failure, 0, identity_of_worker(), 1.0, 0.0, 1)


def bags(count: int) -> list[StudyBag]:
    return [StudyBag(f'bag{i}', Path(f'bag{i}'), f'{i:016x}') for i in range(count)]


def made_rows(count: int, settings: list[Setting], forces: np.ndarray) -> list[Row]:
    """Rows of bags and settings, the recorded one first, with forces [N], shape (bags, n)."""
    return [
        Row(bag, setting, result(float(forces[i, k])))
        for i, bag in enumerate(bags(count))
        for k, setting in enumerate([RECORDED, *settings])
    ]
