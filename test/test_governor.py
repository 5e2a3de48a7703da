"""Under load a tissue concedes nodes far from the tool, says so, and is computed again the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_session import make_session
from test_far_field import NODES, TISSUE, press, slab

from cutting_trainer.bags.comparison import compare
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import read_run
from cutting_trainer.bags.resimulation import as_recorded
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.far_field import SHARES
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.governor import Governor

PERIOD = 1 / 30
SAMPLE = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'straight_cut'


def governed(spent: float, late: float, frames: int, governor: Governor) -> list[int]:
    taken = []
    for _ in range(frames):
        governor.follow(spent, late)
        taken.append(governor.concession)
    return taken


def test_a_stall_concedes_nothing_and_load_concedes_step_by_step() -> None:
    governor = Governor(PERIOD, 2)
    assert governed(0.02, 0.0, 100, governor)[-1] == 0
    assert governed(0.5, 0.9, 2, governor)[-1] == 0, 'two frames in a stall'
    assert governed(0.02, 0.0, 40, governor)[-1] == 0
    assert governed(0.05, PERIOD, 9, governor) == [0, 0, 1, 1, 1, 2, 2, 2, 2]


def test_a_tissue_without_a_far_field_concedes_nothing() -> None:
    mesh = slab()
    dynamics = Dynamics(mesh, TISSUE, 'linear', TimeStepping())
    assert dynamics.possible_concessions == 0
    assert not any(governed(0.05, PERIOD, 20, Governor(PERIOD, dynamics.possible_concessions)))


@pytest.mark.parametrize('price', [1.2, 1.45])
def test_a_concession_is_taken_back_when_there_is_time_and_does_not_come_and_go(
    price: float,
) -> None:
    """Frames of 24 ms with a concession; without, dearer than their period, or not."""
    governor = Governor(PERIOD, 1)
    governed(0.05, PERIOD, 3, governor)
    assert governor.concession == 1
    assert governed(0.024, 0.0, 2000, governor)[-1] == 1, 'without it a frame would be late again'
    taken = governed(0.024 / price, 0.0, 2000, governor)
    assert taken[-1] == 0
    assert np.count_nonzero(np.diff(taken)) == 1


def test_each_concession_is_taken_back_after_a_calm_of_its_own() -> None:
    governor = Governor(PERIOD, 2)
    governed(0.05, PERIOD, 9, governor)
    taken = governed(0.01, 0.0, 2000, governor)
    first, second = (taken.index(concession) for concession in (1, 0))
    assert second - first == first + 1


@pytest.mark.long
def test_what_is_conceded_is_far_from_the_tool_and_the_force_does_not_jump() -> None:
    def pressed(concessions: tuple[int, ...]) -> tuple[list[int], np.ndarray, np.ndarray]:
        active = ActiveSettings('budget', NODES)
        dynamics = Dynamics(slab(), TISSUE, 'linear_smoothed', TimeStepping('rk4'), active)
        counts, forces = [], []
        for k in range(60):
            dynamics.concede(concessions[k // 20])
            depth = 3e-3 * min(k + 1, 10) / 10, 3e-3 * min(k, 10) / 10
            spring = press(dynamics.mesh, (0.03, 0.03), *depth)
            assert not dynamics.advance(spring).trouble
            counts.append(dynamics.active_nodes)
            forces.append(spring.force(dynamics.positions)[2])
        return counts, np.array(forces), dynamics.displacement

    _, whole, shape = pressed((0, 0, 0))
    counts, felt, conceded = pressed((0, 2, 1))
    assert counts[19] == NODES
    assert counts[39] == round(SHARES[2] * NODES)
    assert counts[59] == round(SHARES[1] * NODES)
    peak = np.abs(whole).max()
    assert np.abs(np.diff(felt[15:])).max() < 0.01 * peak
    assert np.abs(felt - whole).max() < 0.02 * peak
    assert np.abs(conceded - shape).max() < 0.04 * np.abs(shape).max()


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cut in a far field of few nodes, which are fewer from frame 10 on and more from 30 on."""
    folder = tmp_path_factory.mktemp('conceded')
    changes = {'tissue.active_region.mode': 'budget', 'tissue.active_region.nodes': '60'}
    return make_session(
        SAMPLE, folder / 'bag', folder, changes=changes, concessions={10: 2, 30: 1, 40: 0}
    )


@pytest.mark.long
def test_a_session_with_concessions_is_computed_again_identically(
    session: Path, tmp_path: Path
) -> None:
    bag = open_bag(session)
    scene = load_scene(str(restore_scene(bag, tmp_path)))
    comparison = compare(bag, recomputation(scene), lambda record, number: 0.0)
    assert comparison.difference is None
    assert comparison.frames > 40
    records, _ = read_run(bag)
    assert [records[k].concession for k in (8, 9, 29, 39)] == [0, 2, 1, 0]
    forgotten = [replace(record, concession=0) for record in records]
    place = ForceSampleCodec.fields['force']
    differing = 0
    frames = as_recorded(forgotten, recomputation(scene))
    for record, frame in zip(forgotten[:60], frames, strict=False):  # before the blade enters
        assert record.force is not None
        differing += bool((frame.force != record.force.values[place]).any())
    assert differing, 'a concession that is not followed is seen'
