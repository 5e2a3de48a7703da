"""Random loads, cuts and yanks of a tissue with slivers are survived or said."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from bench.cuts.random_loads import Outcome, read_outcomes, run_yanks, torture
from cutting_trainer.session.exit_status import Status

pytestmark = pytest.mark.long


def test_a_tissue_that_was_yanked_pressed_or_cut_comes_back_within_a_second() -> None:
    outcome = torture(0, rounds=2)
    assert outcome.frames == 100
    assert outcome.releases == 2
    assert not outcome.failed, outcome


@pytest.mark.parametrize(
    'wrong', [{'bad': 1}, {'silent': 1}, {'inverted': 1}, {'least': 0.8}, {'largest': 1.2}]
)
def test_each_claim_can_fail_a_mesh(wrong: dict[str, float]) -> None:
    assert not Outcome(0, said=3).failed
    assert Outcome(0, **wrong).failed  # type: ignore[arg-type]


def test_a_run_that_was_stopped_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / 'yanks.jsonl'
    done = [Outcome(3, 500, 10), Outcome(4, 500, 10, said=2)]
    lines = [json.dumps(asdict(outcome)) for outcome in done]
    file.write_text('\n'.join(lines) + '\n{"mesh": 5, "fra', encoding='utf-8')
    assert read_outcomes(file) == done
    assert run_yanks(2, 3, file) == Status.OK
    assert '1000 frames, 20 releases: 0 of 2 meshes failed' in capsys.readouterr().out
