"""A button of the device resets the tissue in a cut: it is whole within a second, and cut anew."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from cutting_trainer_msgs.msg import ForceSample
from live import (
    ABOVE,
    FRAME,
    SERVO_CF,
    SPOT,
    LiveSession,
    Recording,
    free_domain,
    onlooker,
    phase,
    wait_for,
    write_scene,
)
from rclpy.node import Node
from ruamel.yaml import YAML
from sensor_msgs.msg import Joy

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import segments
from cutting_trainer.cli import main as cli
from cutting_trainer.node_common import qos
from cutting_trainer.node_common.ros import FORCE, polled, take
from cutting_trainer.node_common.stamps import nanoseconds
from cutting_trainer.session.exit_status import Status
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

pytestmark = pytest.mark.live

SECONDS = 30.0
"""Of the script, longer than the test needs: the test interrupts the session."""
MAX_RESET_S = 1.0


def cuts() -> list[Any]:
    """In, through the block and out, twice."""
    x, y, z = *SPOT, 0.006
    cut = phase(
        'cut', (x, y, z, 1.0), (x + 0.016, y, z, 2.0), (x + 0.016, y, ABOVE, 1.0), share=4.0
    )
    return [phase('approach', (x, y, ABOVE, 1.0)), cut, phase('approach', (x, y, ABOVE, 1.0)), cut]


def wait_for_cut(session: LiveSession) -> None:
    """Returns once the tissue has been cut."""
    with onlooker(session.domain, ForceSample, FORCE) as samples:

        def is_cut() -> bool:
            assert session.launcher.poll() is None, session.said
            sample = take(samples)
            return sample is not None and sample.topology > 0

        wait_for(is_cut, 'a cut')


def press_reset(domain: int) -> None:
    """Presses the device's button until the simulation begins anew."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node('device', context=context)
    presses = node.create_publisher(Joy, 'arm/button', qos.EVENTS)
    samples, seen = polled(node, ForceSample, FORCE, qos.NEWEST_BEST_EFFORT), 0
    pressed = Joy(buttons=[0, 1])

    def is_reset() -> bool:
        nonlocal seen
        if seen:  # else the tissue could be reset before its frames are heard here
            presses.publish(pressed)
        sample = take(samples)
        before, seen = seen, sample.step if sample else seen
        return seen < before

    try:
        wait_for(is_reset, 'the reset')
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp('reset')
    path = write_scene(folder, cuts(), SECONDS, 0.2, 'combined')
    scene = YAML(typ='safe').load(path)
    scene['device'] = {'reset_button': 1}
    YAML().dump(scene, path)
    session = LiveSession(folder, path, free_domain())
    try:
        wait_for_cut(session)
        press_reset(session.domain)
        wait_for_cut(session)
        session.interrupt()
        assert session.end() == Status.INTERRUPTED, session.said
        yield session.bag
    finally:
        session.clean()


@pytest.fixture(scope='module')
def recording(bag: Path) -> Recording:
    return Recording(bag)


def decoded(recording: Recording, topic: str) -> list[Any]:
    return [recording.bag.read(message) for message in recording.messages(topic)]


def test_the_tissue_is_whole_within_a_second_and_is_cut_again(recording: Recording) -> None:
    samples = decoded(recording, f'/{FORCE}')
    steps, cuts = np.array([(s.step, s.topology) for s in samples]).T
    (again,) = np.flatnonzero(np.diff(steps) < 0) + 1
    assert steps[again] == 1 and cuts[again - 1] > 0 and cuts[again] == 0 and cuts[-1] > 0
    last, first = (recording.at(nanoseconds(samples[i].header.stamp)) for i in (again - 1, again))
    print(f'{first - last:.3f} s between the two tissues')
    assert first - last < MAX_RESET_S


def whole_meshes(recording: Recording) -> list[Any]:
    """The meshes before a first frame: of the start, and of the reset."""
    return [mesh for mesh in decoded(recording, '/tissue/mesh') if mesh.step == 0]


def test_followers_go_on_by_one_mesh_and_its_deltas(recording: Recording) -> None:
    first, whole = whole_meshes(recording)
    for name in ('rest', 'displacement', 'fixed', 'tetrahedra', 'triangles'):
        assert np.array_equal(getattr(whole, name), getattr(first, name)), name
    assert whole.topology == 0
    replica = MeshReplica()
    replica.load(whole)
    deltas = decoded(recording, '/tissue/mesh_updates')
    later = [d for d in deltas if d.revision > whole.revision]
    assert later and all(replica.apply(delta) for delta in later)
    assert max(d.revision for d in deltas if d not in later) == whole.revision - 1


def test_force_fades_to_zero_meanwhile(recording: Recording) -> None:
    _, whole = whole_meshes(recording)
    at = recording.at(nanoseconds(whole.header.stamp))
    times, norms = recording.force(SERVO_CF)
    assert norms[(at - 0.2 < times) & (times < at)].max() > 0
    assert norms[(at < times) & (times < at + 10 * FRAME)].min() == 0


def test_a_bag_computes_again_up_to_the_reset(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = segments(open_bag(bag))
    assert before.first == after.first == 1
    with pytest.raises(SystemExit) as left:
        cli.main(['resimulate', str(bag)])
    assert left.value.code == Status.OK
    said = capsys.readouterr().out
    assert 'identical' in said and 'the tissue began again, at frame 1' in said
