"""What nodes decide, message by message: their methods on stand-ins, without a graph."""

from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cutting_trainer_msgs.srv import Cut, GetMesh
from meshes import box

from cutting_trainer.bags import recorder_node
from cutting_trainer.bags.metadata import Tally
from cutting_trainer.bags.recorder_node import Recorder
from cutting_trainer.cutting import node as cutting_node
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.node import CuttingNode
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.haptic_bridge.emulated_arm.faults import DriverFaults
from cutting_trainer.haptic_bridge.emulated_arm.node import ArmNode
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.tissue_sim import node as tissue_node
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.node import TissueSimNode
from cutting_trainer.tissue_sim.streaming import link_budget
from cutting_trainer.tissue_sim.streaming.link_budget import LinkBudget
from cutting_trainer.tissue_sim.streaming.messages import mesh_message
from cutting_trainer.viewer.operator_commands import known_state


def test_the_button_is_published_as_an_event_and_not_while_it_is_held() -> None:
    sent: list[int] = []
    arm: Any = SimpleNamespace(
        _pressed=False, _button=SimpleNamespace(publish=lambda m: sent.append(m.buttons[0]))
    )
    for pressed in (False, True, True, False, False, True):
        ArmNode._press(arm, pressed)
    assert sent == [1, 0, 1]


def test_a_pose_is_sent_in_the_order_and_scale_of_the_driver() -> None:
    pose = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.9)
    assert DriverFaults.read('w_first=1').pose(pose) == (1.0, 2.0, 3.0, 0.9, 0.1, 0.2, 0.3)
    assert DriverFaults.read('scale=2').pose(pose) == (2.0, 4.0, 6.0, 0.1, 0.2, 0.3, 0.9)


def test_a_state_that_is_none_of_crtks_is_unknown() -> None:
    for state in CrtkState:
        assert known_state(str(state.value)) is state
    assert known_state('WORKING') is None


def test_a_link_that_has_sent_all_it_may_holds_the_next_message_back() -> None:
    message = mesh_message(TetMesh(*box((1, 1, 1), 0.01)), np.zeros((8, 3)), '', 0, 0, 0)
    probe = LinkBudget(1.0)
    probe.spend(message)
    burst = probe.sent
    link = LinkBudget(burst / link_budget._BURST_S)
    assert link.allows(1.0) and link.allows(1000.0)
    link.spend(message)
    assert not link.allows(1000.0) and link.held_back == 1, 'a pause saves up one burst at most'
    assert link.allows(1000.001)


def test_the_times_of_a_bag_are_those_of_its_earliest_and_latest_message() -> None:
    tally, other = Tally(), Tally()
    for topic, log_time in (('/a', 5), ('/b', 3), ('/a', 9), ('/a', 7)):
        tally.add(topic, log_time)
    assert (tally.start, tally.end, tally.counts) == (3, 9, {'/a': 3, '/b': 1})
    tally.merge(other)
    other.add('/b', 2)
    tally.merge(other)
    assert (tally.start, tally.end, tally.messages) == (2, 9, 5)


def test_a_recorder_goes_on_until_states_are_complete_and_no_longer_than_they_may_take(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, done = [100.0], []
    clock = SimpleNamespace(
        monotonic=lambda: now[0], sleep=lambda s: now.__setitem__(0, now[0] + s)
    )
    monkeypatch.setattr(recorder_node, 'time', clock)
    missing = [True, True, False]
    recorder: Any = SimpleNamespace(
        _expects_states=lambda: missing.pop(0),
        discover=lambda: done.append('discover'),
        drain=lambda: done.append('drain'),
    )
    Recorder._await_states(recorder)
    assert done == ['discover', 'drain'] * 2
    recorder._expects_states = lambda: True
    began = now[0]
    Recorder._await_states(recorder)
    assert 0.0 <= now[0] - began - recorder_node._STATE_TIMEOUT_S < 1.0


@pytest.mark.parametrize('failure', ['', 'the disk is full'])
def test_a_bag_that_lacks_messages_at_its_end_is_announced(
    monkeypatch: pytest.MonkeyPatch, failure: str
) -> None:
    said: list[str] = []
    done: list[str] = []
    monkeypatch.setattr(recorder_node, 'announce', said.append)
    recorder: Any = SimpleNamespace(
        writer=SimpleNamespace(
            describe=lambda **_: done.append('describe'),
            close=lambda: done.append('close'),
            failure=failure,
            lost={'/a': 2, '/b': 1},
        ),
        _collector=SimpleNamespace(text=''),
        _report_accounts=done.append,
        accounts=lambda: 'accounts',
        get_name=lambda: 'recorder',
    )
    Recorder.release(recorder)
    assert done == ['describe', 'close', 'accounts']
    lost = ['failed: recorder: the disk is full: 3 messages are not in the bag']
    assert said == (lost if failure else [])


@pytest.mark.parametrize('active', [False, True])
def test_a_node_that_ends_rests_if_it_works_and_gives_back_what_it_configured(active: bool) -> None:
    done: list[str] = []
    node: Any = SimpleNamespace(
        _active=active,
        _before={'a publisher'},
        rest=lambda: done.append('rest'),
        release=lambda: done.append('release'),
    )
    ManagedNode.end(node)
    assert done == (['rest', 'release'] if active else ['release'])
    assert not node._active


def test_a_replica_without_a_mesh_is_of_no_revision_and_no_connectivity() -> None:
    replica = MeshReplica()
    assert (replica.revision, replica.topology, len(replica.rest)) == (-1, -1, 0)


def test_a_tissue_that_was_reset_goes_on_whole_though_a_follower_knows_the_cut_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The revision says which mesh is the newer one; a reset begins the topology anew."""
    mesh = TetMesh(*box((1, 1, 1), 0.01))
    known = [mesh_message(mesh, np.zeros((8, 3)), '', revision, 4, 0) for revision in (41, 42)]
    known[0].topology = 6
    for found in (known, known[::-1]):
        monkeypatch.setattr(tissue_node, 'recover_meshes', lambda _, found=found: found)
        logger = SimpleNamespace(warning=lambda _: None)
        node: Any = SimpleNamespace(_file=None, get_logger=lambda logger=logger: logger)
        before = TissueSimNode._tissue_before(node)
        assert before is not None
        assert (before.revision, before.topology) == (42, 0)


def cutting(revision: int) -> Any:
    """The node `cutting` with a block of tissue at a revision."""
    mesh = TetMesh(*box((2, 2, 2), 0.01))
    still = np.zeros_like(mesh.rest)
    message: Any = mesh_message(mesh, still, '', revision, 4, 0)
    replica = MeshReplica()
    replica.load(message)
    settings, asked = CuttingSettings(), []
    return SimpleNamespace(
        _settings=settings,
        _tools=2,
        _method=make_method(settings),
        _replica=replica,
        _mesh=replica.mesh(),
        _displacements=deque([(revision - 1, still), (revision, still)]),
        _ahead=None,
        _asking=False,
        _ask_for_mesh=lambda: asked.append('mesh'),
        _rebuild=asked.append,
        asked=asked,
    )


def answer(node: Any, **request: Any) -> tuple[int, str]:
    code, result = CuttingNode._cut(node, Cut.Request(**{'command': 1, 'revision': 7} | request))
    assert (result is not None) == (code[0] == Cut.Response.OK)
    return code


def test_a_cut_is_refused_with_the_reason_until_its_mesh_is_at_hand() -> None:
    node = cutting(7)
    assert answer(node)[0] == Cut.Response.OK
    assert answer(node, tool=1)[0] == Cut.Response.OK
    code, text = answer(node, tool=2)
    assert code == Cut.Response.INVALID_SWEEP and 'the scene has 2, from 0' in text
    assert answer(node, command=9)[0] == Cut.Response.INVALID_SWEEP
    assert node.asked == []
    code, text = answer(node, revision=8)
    assert code == Cut.Response.WRONG_REVISION and 'revisions 6 to 7 are' in text
    assert node.asked == [], 'its delta may be on the way'
    far = 8 + cutting_node._MAX_DELTAS_AHEAD
    assert answer(node, revision=far)[0] == Cut.Response.WRONG_REVISION
    assert node.asked == ['mesh']
    assert answer(node, command=2)[0] == Cut.Response.OK
    assert 'aborted' in node.asked[1]
    node._replica.topology += 1
    assert answer(node)[0] == Cut.Response.OK
    assert 'was not applied' in node.asked[2]
    node._mesh = None
    assert answer(node)[0] == Cut.Response.NOT_READY


def test_a_new_simulation_gets_the_tissue_with_the_cut_that_was_answered_last() -> None:
    node = cutting(7)
    count = node._mesh.node_count
    mesh = CuttingNode._serve_mesh(node, None, GetMesh.Response()).mesh
    assert (mesh.revision, len(mesh.rest), len(mesh.displacement)) == (7, 3 * count, 3 * count)
    node._replica.topology += 1
    node._ahead = np.full((count + 5, 3), 0.5)
    node._method = SimpleNamespace(abort=lambda: node.asked.append('abort'))
    mesh = CuttingNode._serve_mesh(node, None, GetMesh.Response()).mesh
    assert mesh.revision == 8
    np.testing.assert_array_equal(mesh.displacement, np.full(3 * count, 0.5))
    assert node.asked == ['abort'], 'the stroke is not known to it'
    node._mesh = None
    assert not CuttingNode._serve_mesh(node, None, GetMesh.Response()).success


def test_nodes_that_a_cut_makes_are_ahead_where_the_tissue_is_displaced_to() -> None:
    node = cutting(7)
    stretch = np.array([0.02, -0.01, 0.03])
    node._displacements[-1] = (7, node._mesh.rest * stretch)
    count = node._mesh.node_count
    way = {
        'root_from': [-0.01, 0.011, 0.03],
        'tip_from': [-0.01, 0.011, -0.01],
        'root_to': [0.03, 0.011, 0.03],
        'tip_to': [0.03, 0.011, -0.01],
    }
    assert answer(node, command=0, **way)[0] == Cut.Response.OK
    assert node._mesh.node_count > count
    ahead = node._ahead[: node._mesh.node_count]
    np.testing.assert_allclose(ahead, node._mesh.rest * stretch, atol=1e-12)
