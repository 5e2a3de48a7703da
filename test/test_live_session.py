"""A whole session on the real graph, and sessions that the user interrupts."""

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_copies import moved_by, rewritten
from live import (
    CONTACT,
    MEASURED_CP,
    NODES,
    PRESSING,
    SERVO_CF,
    SPOT,
    TISSUE_FORCE,
    LiveSession,
    Recording,
    free_domain,
    phase,
    two_presses,
    wait_for,
    write_scene,
    zero_from,
)
from rosbags.highlevel import AnyReader

from cutting_trainer.bags.comparison import compare
from cutting_trainer.bags.metadata import read_metadata, recorded_code
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import read_run
from cutting_trainer.bags.topic_names import CUTS, DIAGNOSTICS
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.code_identity import identity_here
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica

pytestmark = pytest.mark.live

DEVICE = DeviceSettings().load_profile()
SECONDS = 10.5
"""Twice the time between keyframes and more: one of them shows the tissue after the cut."""
ANSWERED = 0.1
"""[s] of a contact in which the hand may feel the proxy's spring, not yet the tissue."""
HOVER = 0.015
"""[m] height of the tip 1 mm before it touches."""
SETTLING = 0.1
"""[s] in which the tissue that the blade or the tip has left is let go by the simulation."""
SENT_LATE = 1e-3
"""[s] between a tick's reading of the clock and the stamp of its command, on a busy machine."""


@pytest.fixture(scope='module')
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveSession]:
    """Palpates at two places, cuts from one side to the other, and retracts."""
    folder = tmp_path_factory.mktemp('whole')
    x, y = SPOT
    second = (0.0, 0.010)
    phases = [
        phase('approach', (x, y, HOVER, 1.0), share=0.8),
        phase(
            'palpate',
            *((x, y, 0.0105, 1.5), (x, y, HOVER, 0.8), (*second, HOVER, 0.8)),
            *((*second, 0.0105, 1.5), (*second, HOVER, 0.8), (x, 0.004, 0.018, 0.8)),
            share=5.0,
        ),
        phase('cut', (x, 0.004, 0.006, 1.0), (0.016, 0.004, 0.008, 1.5), share=2.2),
        phase('retract', (0.016, 0.004, 0.040, 1.0), share=1.0),
        phase('rest', share=1.5),
    ]
    session = LiveSession(
        folder, write_scene(folder, phases, SECONDS, cut_threshold=0.2), free_domain()
    )
    yield session
    session.clean()


@pytest.fixture(scope='module')
def recording(session: LiveSession) -> Recording:
    assert not session.complaints(), session.said
    return Recording(session.bag)


def palpations(recording: Recording) -> list[tuple[float, float]]:
    """When the tip touched the tissue, whole and from outside [s]: from, to."""
    times, states = recording.read(CONTACT, ContactCodec(), 'state')
    touching = np.concatenate([[0], states[:, 0] > 0, [0]])
    edges = np.flatnonzero(np.diff(touching))
    cut = times[states[:, 0] > 1][0]
    spans = [(times[a], times[b - 1]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(start, end) for start, end in spans if end < cut and end - start > 0.1]


def test_session_runs_to_its_end_and_says_so(session: LiveSession, recording: Recording) -> None:
    assert recording.complete
    assert not session.running()
    assert (session.bag / 'log').is_dir()
    assert 'elements cut' in session.said


def test_bag_of_a_session_holds_scene_seed_versions_parameters_and_service_calls(
    session: LiveSession, recording: Recording
) -> None:
    about = recording.bag.custom_data
    assert about['scene'] == session.scene.read_text() and about['scene_file'] == session.scene.name
    assert about['seed'] == '0' and recorded_code(about) == identity_here()
    parameters = yaml.safe_load(about['parameters'])
    assert parameters.keys() >= {f'/{node}' for node in NODES}
    assert parameters['/haptic_bridge']['auto_enable'] is True
    calls = [recording.bag.read(message) for message in recording.messages(CUTS)]
    assert any(call.request for call in calls) and any(call.response for call in calls)
    assert '/arm/operating_state/_service_event' in recording.bag.topics()


def test_losses_on_diagnostics_are_topic_by_topic_those_of_the_sequence_numbers(
    recording: Recording,
) -> None:
    arrays = map(recording.bag.read, recording.messages(DIAGNOSTICS))
    (last,) = [a.status[0] for a in arrays if a.status[0].name == 'recorder'][-1:]
    counts = {pair.key: pair.value for pair in last.values}
    numbers = [m.sequence for m in recording.messages(CONTACT)]
    gaps = sum(np.diff(numbers)) - (len(numbers) - 1)
    assert 0 <= int(counts[f'lost {CONTACT}']) <= gaps
    heard, written = (int(counts[f'{word} {CONTACT}']) for word in ('received', 'written'))
    assert 0 < written <= heard <= len(numbers)
    for topic in (MEASURED_CP, SERVO_CF, TISSUE_FORCE):
        assert f'lost {topic}' in counts and f'missed {topic}' in counts


def test_there_is_no_force_before_the_first_contact_and_none_after_the_last(
    recording: Recording,
) -> None:
    times, norms = recording.force(SERVO_CF)
    contacts, states = recording.read(CONTACT, ContactCodec(), 'state')
    touching = contacts[states[:, 0] > 0]
    assert times[0] < touching[0] - 0.3
    assert times[-1] > touching[-1] + 0.3
    assert not norms[times < touching[0]].any()
    assert norms[(times > touching[0]) & (times < touching[-1])].any()
    assert zero_from(times, norms) < touching[-1] + SETTLING


def test_force_rises_with_depth_on_the_way_in_of_each_palpation(recording: Recording) -> None:
    times, forces = recording.read(SERVO_CF, WrenchStampedCodec(), 'force')
    poses, positions = recording.read(MEASURED_CP, PoseStampedCodec(), 'position')
    heights = np.interp(times, poses, positions[:, 2])
    found = palpations(recording)
    assert len(found) == 2
    for start, end in found:
        inside = np.flatnonzero((times >= start) & (times <= end))
        way_in = inside[: 1 + np.argmin(heights[inside])]
        depth, force = heights[way_in[0]] - heights[way_in], forces[way_in, 2]
        assert depth[-1] > 1e-3 and force[-1] > 0.05
        correlation = np.corrcoef(depth**1.5, force)[0, 1]  # Hertz: a sphere on elastic tissue
        print(f'correlation {correlation:.4f} to {depth[-1] * 1e3:.2f} mm')
        assert correlation > 0.98
        answered = force[times[way_in] > start + ANSWERED]
        assert (np.maximum.accumulate(answered) - answered).max() < 0.1 * force.max()


def test_energy_of_the_tissue_decays_after_each_release(recording: Recording) -> None:
    times, states, kinetic, elastic = recording.read(
        TISSUE_FORCE, ForceSampleCodec(), 'state', 'kinetic_energy', 'elastic_energy'
    )
    energy, loaded = (kinetic + elastic)[:, 0], states[:, 0] > 0
    released = np.flatnonzero(loaded[:-1] & ~loaded[1:]) + 1
    starts = np.append(np.flatnonzero(~loaded[:-1] & loaded[1:]), len(loaded) - 1)
    free = [(a, starts[starts >= a][0]) for a in released]
    long = [(a, b) for a, b in free if times[b] - times[a] > 0.3]
    assert len(long) >= 3
    for a, b in long:
        largest = energy[:a].max()
        assert np.diff(energy[a : b + 1]).max() <= 1e-9 * largest
        assert energy[b] < 1e-3 * largest


def test_commanded_force_stays_within_what_the_device_bears(recording: Recording) -> None:
    times, forces = recording.read(SERVO_CF, WrenchStampedCodec(), 'force')
    assert np.linalg.norm(forces, axis=1).max() <= DEVICE.max_force
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    assert (steps <= DEVICE.max_slew * (np.diff(times) + SENT_LATE)).all()


def test_every_message_of_the_bag_is_counted_and_understood_by_rosbags(
    session: LiveSession, recording: Recording
) -> None:
    counts: Counter[str] = Counter()
    with AnyReader([session.bag]) as reader:
        for connection, _, data in reader.messages():
            if '/srv/' not in connection.msgtype:  # rosbags has no types of service events
                reader.deserialize(data, connection.msgtype)
            counts[connection.topic] += 1
    entries = read_metadata(session.bag)['topics_with_message_count']
    listed = {entry['topic_metadata']['name']: entry['message_count'] for entry in entries}
    assert counts == {topic: count for topic, count in listed.items() if count}
    assert counts == {t: len(recording.messages(t)) for t in counts}
    assert counts[SERVO_CF] > 1000 * SECONDS / 2


def test_deltas_lead_from_the_first_keyframe_to_the_arrays_of_each_later_one_bit_for_bit(
    recording: Recording,
) -> None:
    first, *others = (recording.bag.read(message) for message in recording.messages('/tissue/mesh'))
    later = {mesh.revision: mesh for mesh in others if mesh.revision > first.revision}
    assert later
    replica = MeshReplica()
    replica.load(first)
    assert replica.hash() == first.state_hash
    for delta in map(recording.bag.read, recording.messages('/tissue/mesh_updates')):
        assert replica.apply(delta)
        if delta.state_hash:
            assert replica.hash() == delta.state_hash
        if mesh := later.pop(delta.revision, None):
            assert (replica.topology, replica.hash()) == (mesh.topology, mesh.state_hash)
    assert not later
    assert replica.topology > first.topology


MOMENTS = {
    'as the first node starts': lambda session: wait_for(
        lambda: len(session.running()) > 1, 'a node'
    ),
    'while the nodes start': lambda session: session.wait_until_said('recorder is ready'),
    'in contact': lambda session: session.wait_until_pressed(PRESSING),
}


@pytest.fixture
def interrupted(tmp_path: Path) -> Iterator[LiveSession]:
    scene = write_scene(tmp_path, two_presses(), 7.0, cut_threshold=100.0)
    session = LiveSession(tmp_path, scene, free_domain())
    yield session
    session.clean()


def assert_nothing_left(session: LiveSession) -> None:
    """No process, and no bag that cannot be read."""
    assert session.end() == Status.INTERRUPTED, session.said
    assert not session.running()
    assert 'Traceback' not in session.said
    assert 'interrupted (exit status 130)' in session.said
    if list(session.bag.glob('*.mcap')):
        with AnyReader([session.bag]) as reader:
            assert sum(1 for _ in reader.messages()) == reader.message_count


def test_interrupt_of_a_launcher_that_has_just_begun_ends_it(interrupted: LiveSession) -> None:
    wait_for(interrupted.running, 'the launcher')
    interrupted.interrupt()
    assert interrupted.end() != Status.OK  # Python itself may not have started yet
    assert not interrupted.running()


@pytest.mark.parametrize('moment', MOMENTS)
def test_interrupt_ends_every_process_and_closes_the_bag(
    interrupted: LiveSession, moment: str
) -> None:
    MOMENTS[moment](interrupted)
    interrupted.interrupt()
    assert_nothing_left(interrupted)
    if moment == 'in contact':
        assert Recording(interrupted.bag).complete
        assert set(NODES) == {path.stem for path in (interrupted.bag / 'log').iterdir()}


@pytest.mark.thorough
@pytest.mark.parametrize('pause', [0.0, 0.3])
def test_second_interrupt_leaves_nothing_either(interrupted: LiveSession, pause: float) -> None:
    interrupted.wait_until_pressed(PRESSING)
    interrupted.interrupt()
    time.sleep(pause)
    interrupted.interrupt()
    assert_nothing_left(interrupted)
    assert Recording(interrupted.bag).complete


@pytest.mark.thorough
def test_interrupt_while_the_bag_is_read_at_the_end_is_an_interrupt_as_any(
    interrupted: LiveSession,
) -> None:
    interrupted.wait_until_pressed(PRESSING)
    interrupted.interrupt()
    wait_for(lambda: list(interrupted.running()) == ['launcher'], 'the nodes to end')
    interrupted.interrupt()
    assert_nothing_left(interrupted)


def test_a_live_session_is_computed_again_from_its_bag_bit_for_bit(
    session: LiveSession, recording: Recording, tmp_path: Path
) -> None:
    bag = recording.bag
    scene = load_scene(str(restore_scene(bag, tmp_path)))
    result = compare(bag, recomputation(scene), pose_check(scene))
    assert result.identical
    assert not result.missing
    assert result.frames > 20 * SECONDS / 2
    assert result.hashes > 1


def test_one_pose_changed_in_the_bag_of_a_live_session_is_caught_at_its_frame(
    session: LiveSession, recording: Recording, tmp_path: Path
) -> None:
    bag = recording.bag
    records = [record for record in read_run(bag)[0] if record.has_contact]
    changed = records[len(records) // 2]
    assert changed.pose is not None
    rewritten(session.bag, tmp_path / 'bag', moved_by(1e-7, changed.pose.stamp_ns))
    scene = load_scene(str(restore_scene(bag, tmp_path)))
    result = compare(open_bag(tmp_path / 'bag'), recomputation(scene), pose_check(scene))
    assert result.difference is not None
    assert result.difference.step == changed.step
