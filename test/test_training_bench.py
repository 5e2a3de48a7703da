"""Claims about the emulated people and the area under the ROC curve."""

import pytest

from bench.training.people import MUST_FAIL, SKILLED, person
from bench.training.player import expert_script, scene_of
from bench.training.runner import EXERCISES, auc, wanted
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.exercises.score import score
from cutting_trainer.haptic_bridge.emulated_arm.hand import compile_script


def test_area_under_the_curve_of_known_samples() -> None:
    assert auc([3, 4], [1, 2]) == 1.0
    assert auc([1, 2], [3, 4]) == 0.0
    assert auc([1, 2], [1, 2]) == 0.5
    assert auc([2, 4], [1, 3]) == 0.75


def test_any_part_of_a_run_is_balanced_and_seeds_are_kept() -> None:
    rows = list(wanted(EXERCISES, 40))
    assert len(set(rows)) == len(rows) == 5 * (3 + 2 * 40)
    assert list(wanted(EXERCISES, 10)) == rows[: 5 * (3 + 2 * 10)]


@pytest.mark.parametrize('scene', EXERCISES)
def test_every_person_has_a_way_that_a_hand_can_go(scene) -> None:
    frame = scene_of(scene).device.tissue_from_device
    for kind in (*SKILLED, *MUST_FAIL):
        for seed in range(3):
            compile_script(person(scene, kind, seed).script, frame)
    assert person(scene, 'novice', 3) == person(scene, 'novice', 3)
    assert person(scene, 'novice', 3) != person(scene, 'novice', 4)


@pytest.mark.parametrize('scene', EXERCISES)
def test_nothing_done_fails_by_the_score_alone(scene) -> None:
    exercise = scene_of(scene).exercise
    assert not score(exercise, Attempt(exercise).measures()).passed
    assert expert_script(scene).script.seconds < exercise.time_limit
