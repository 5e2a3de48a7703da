"""Modes of the tool: by the scene, while the session runs, and computed again as they were."""

from pathlib import Path

import numpy as np
import pytest
from made_session import make_session
from rig import QUIET, RADIUS, Rig

from cutting_trainer import simulate
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.resimulation import as_recorded
from cutting_trainer.haptic_bridge.scene_schema import ToolSettings
from cutting_trainer.node_common.cdr_codec import ContactCodec, ForceSampleCodec
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.recordings.recorded_hand import computable_poses
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.recordings.what_if import run_experiment
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.tool import ToolMode

SAMPLE = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_7' / 'straight_cut'
MODE = ContactCodec.fields['mode'].start
PALPATOR, SCALPEL = ToolMode.PALPATOR, ToolMode.SCALPEL


def test_a_palpator_that_presses_as_hard_as_a_scalpel_never_goes_in() -> None:
    session = simulate('block')
    session.path.next_mode = PALPATOR
    path = np.linspace(-0.010, -0.022, 600)
    pressed = [session.tick(np.array([-0.012, -0.008, z])).wrench[2] for z in path]
    assert max(pressed) > 0.03  # threshold of the block [N]
    assert session.tissue.simulation.elements_cut == 0
    session.path.next_mode = SCALPEL
    for _ in range(100):
        session.tick(np.array([-0.012, -0.008, path[-1]]))
    assert session.tissue.simulation.blade is not None


def test_the_mode_is_that_of_the_scene_and_changes_outside_of_the_tissue_only() -> None:
    rig = Rig(haptics=QUIET, tool=ToolSettings(radius=RADIUS, mode='palpator'))
    rig.run(np.linspace(0.005, 0.001, 60))
    assert rig.ticks[-1].contact[MODE] == PALPATOR
    rig.path.next_mode = SCALPEL
    rig.run(0.001)
    assert rig.ticks[-1].contact[MODE] == SCALPEL
    rig.inside = True
    rig.run(np.full(70, 0.001))
    rig.path.next_mode = PALPATOR
    rig.run(np.full(70, 0.001))
    assert rig.ticks[-1].contact[MODE] == rig.path.mode == SCALPEL
    rig.inside = False
    rig.run(np.full(70, 0.02))
    assert rig.ticks[-1].contact[MODE] == rig.path.mode == PALPATOR


def test_a_grasper_lifts_the_tissue_and_the_hand_feels_its_pull_until_the_jaws_open() -> None:
    session = simulate('block')
    session.path.next_mode = ToolMode.OPEN_GRASPER
    down = np.linspace(-0.010, -0.019, 400)

    def at(z: float) -> np.ndarray:
        return np.array([-0.012, -0.008, z])

    for z in down:
        session.tick(at(z))
    session.wait(0.3, at(down[-1]))
    session.path.next_mode = ToolMode.CLOSED_GRASPER
    top = float(session.tissue.simulation.positions[:, 2].max())
    felt = []
    for z in np.linspace(down[-1], -0.008, 1200):
        felt.append(session.tick(at(z)).wrench[2])
    session.wait(0.3, at(-0.008))
    last = session.tick(at(-0.008)).wrench[2]
    assert session.frame is not None
    assert last == pytest.approx(session.frame.force[2], rel=0.05)
    assert last < -0.05, 'the tissue pulls the hand down'
    assert max(np.abs(np.diff(felt))) < 0.02, 'no jump where the jaws close'
    assert session.tissue.simulation.positions[:, 2].max() > top + 2e-3
    for half in 0.15 * (1 - np.cos(np.linspace(0.0, 2 * np.pi, 400))):
        turned = session.tick(at(-0.008), (0.0, np.sin(half), 0.0, np.cos(half))).wrench
        assert turned[2] == pytest.approx(last, rel=0.02), 'jaws hold a point: a turn is not felt'
        assert not any(turned[3:])
    session.path.next_mode = ToolMode.OPEN_GRASPER
    session.wait(0.3, at(-0.008))
    assert session.tick(at(-0.008)).wrench[2] >= 0.0


def test_jaws_let_go_where_no_force_may_be_commanded() -> None:
    rig = Rig(haptics=QUIET, tool=ToolSettings(radius=RADIUS, mode='closed_grasper'))
    rig.run(np.linspace(0.005, 0.001, 60))
    assert rig.ticks[-1].contact[MODE] == ToolMode.CLOSED_GRASPER
    rig.state = CrtkState.DISABLED
    rig.run(0.001)
    assert rig.ticks[-1].contact[MODE] == ToolMode.OPEN_GRASPER


@pytest.mark.long
def test_a_session_in_which_the_mode_changes_is_computed_again_as_it_was(tmp_path: Path) -> None:
    for folder in ('scene', 'again'):
        (tmp_path / folder).mkdir()
    made = make_session(SAMPLE, tmp_path / 'bag', tmp_path / 'scene', modes={2: PALPATOR})
    bag = open_bag(made)
    scene = load_scene(str(restore_scene(bag, tmp_path / 'again')))
    assert scene.tool.mode == 'scalpel'
    records, _ = computable_poses(bag)
    assert {record.contact.mode for record in records if record.contact} == {SCALPEL, PALPATOR}
    computed, place = recomputation(scene), ForceSampleCodec.fields['force']
    for record, frame in zip(records, as_recorded(records, computed), strict=True):
        assert record.force is not None
        np.testing.assert_array_equal(frame.force, record.force.values[place])
    assert computed.simulation.elements_cut == 0
    # From the hand alone, too.
    assert run_experiment(bag, scene, recomputation(scene)).elements_cut == 0
