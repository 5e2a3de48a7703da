"""What a soak calls growth: of any process's memory, threads or handles, after the warm-up."""

import os
from pathlib import Path

import numpy as np
import pytest

from bench.trials.soak import (
    MAX_ABSOLUTE_GROWTH,
    WARM_UP_SHARE,
    Sample,
    growth_failures,
    remove_old,
)

pytestmark = pytest.mark.long

HOUR = np.arange(0.0, 3600.0, 5.0)
STEADY = {'memory [MB]': 200.0, 'threads': 12.0, 'file handles': 40.0}


def watched(name: str, values: np.ndarray) -> list[Sample]:
    return [
        Sample(t, 'recorder', STEADY | {name: value}) for t, value in zip(HOUR, values, strict=True)
    ]


def noisy(middle: float) -> np.ndarray:
    return middle + np.random.default_rng(0).uniform(-2.0, 2.0, len(HOUR))


def test_noise_and_what_fills_at_the_start_are_no_growth() -> None:
    filling = noisy(200.0) - np.where(WARM_UP_SHARE * HOUR[-1] > HOUR, 100.0, 0.0)
    assert not growth_failures(watched('memory [MB]', filling))


@pytest.mark.parametrize(
    ('name', 'per_hour'), [('memory [MB]', 30.0), ('threads', 2.0), ('file handles', 6.0)]
)
def test_a_steady_leak_is_named(name: str, per_hour: float) -> None:
    leak = STEADY[name] + np.floor(per_hour * HOUR / HOUR[-1])
    (said,) = growth_failures(watched(name, leak))
    assert said.startswith(f'{name} of recorder grew from ')


def test_entities_of_the_graph_may_not_pile_up() -> None:
    piled = [Sample(t, 'graph', {'DDS entities': 300 + t // 60}) for t in HOUR]
    level = [Sample(t, 'graph', {'DDS entities': 300 + t // 5 % 2}) for t in HOUR]
    assert growth_failures(piled) and not growth_failures(level)
    assert MAX_ABSOLUTE_GROWTH['DDS entities'] < 60


def test_the_bag_that_is_being_written_is_kept_whatever_its_name(tmp_path: Path) -> None:
    names = ('bag-2', 'bag-3', 'bag')  # the recorder has found `bag` free again
    for age, name in enumerate(names):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (1e9 + age, 1e9 + age))
    remove_old([tmp_path / name for name in ('bag', 'bag-2', 'bag-3', 'bag-4')])
    assert {path.name for path in tmp_path.iterdir()} == {'bag-3', 'bag'}
