"""The recorder on a real graph: what was published is in the bag, byte for byte."""

import itertools
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from cutting_trainer_msgs.msg import Contact, FrameInputs, MeshDelta, State
from geometry_msgs.msg import PoseStamped
from live import PATIENCE, ROOT, wait_for
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_system_default
from rclpy.serialization import serialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from recording import DOMAIN, RecorderProcess, source
from rosbags.highlevel import AnyReader
from std_msgs.msg import String
from std_srvs.srv import SetBool

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorder_node import Recorder
from cutting_trainer.bags.repair import repair_bag
from cutting_trainer.node_common.qos import LATCHED, STREAM, UPDATES
from cutting_trainer.node_common.ros import CONTACT, FRAME_INPUTS, MESH_UPDATES, TISSUE_STATE
from cutting_trainer.session.scene_loader import find_scene

pytestmark = pytest.mark.live


@pytest.fixture
def node() -> Iterator[Node]:
    with source() as node:
        yield node


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[RecorderProcess]:
    (tmp_path / 'scene.yaml').write_text('name: block\n')
    recorder = RecorderProcess(tmp_path / 'bag', scene=tmp_path / 'scene.yaml', seed=11)
    yield recorder
    if recorder.process.poll() is None:
        recorder.process.kill()
        recorder.process.wait()


def heard(node: Node, message_type: Any, topic: str, qos: QoSProfile) -> Any:
    """A publisher that the recorder has subscribed to."""
    publisher = node.create_publisher(message_type, topic, qos)
    wait_for(lambda: publisher.get_subscription_count() == 1, f'the recorder to hear {topic}')
    return publisher


def poses(count: int) -> Iterator[bytes]:
    source = random.Random(5)
    for i in range(count):
        pose = PoseStamped()
        pose.header.frame_id = f'device {i}'
        pose.pose.position.x = source.random()
        yield serialize_message(pose)


def publish_at_1_khz(publisher: Any, messages: Iterator[bytes]) -> list[bytes]:
    sent = []
    deadline = time.monotonic()
    for data in messages:
        publisher.publish(data)
        sent.append(data)
        deadline += 0.001
        time.sleep(max(0.0, deadline - time.monotonic()))
    return sent


def recorded(folder: Path, topic: str) -> list[bytes]:
    with AnyReader([folder]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [bytes(data) for _, _, data in reader.messages(chosen)]


def read_topic(folder: Path, topic: str) -> list[Any]:
    bag = open_bag(folder)
    return [bag.read(message) for message in bag.messages([topic])]


def test_every_message_of_a_1_khz_stream_is_in_the_bag_byte_for_byte(
    node: Node, recorder: RecorderProcess
) -> None:
    publisher = heard(node, PoseStamped, '/stream', QoSProfile(depth=1000))
    sent = publish_at_1_khz(publisher, poses(2000))
    time.sleep(0.3)
    said = recorder.end()
    assert recorder.process.returncode == 0
    assert re.match(rf'recorded: \d+ messages, \d+ topics, 0 lost, {recorder.folder}\n', said)
    assert '  /stream: 2000 received, 2000 written, 0 lost\n' in said
    assert recorded(recorder.folder, '/stream') == sent
    bag = open_bag(recorder.folder)
    assert bag.complete
    assert bag.custom_data['scene'] == 'name: block\n'
    assert bag.custom_data['seed'] == '11'
    times = [(m.log_time, m.publish_time) for m in bag.messages(['/stream'])]
    assert all(0 < log - published < 1e9 for log, published in times)


def test_a_stream_that_keeps_only_the_newest_is_in_the_bag_or_counted_as_lost(
    node: Node, recorder: RecorderProcess
) -> None:
    publisher = heard(node, PoseStamped, '/stream', STREAM)
    sent = publish_at_1_khz(publisher, poses(2000))
    time.sleep(0.3)
    said = recorder.end(signal.SIGTERM)
    assert recorder.process.returncode == 0
    lost = int(re.search(r'(\d+) lost', said)[1])
    got = recorded(recorder.folder, '/stream')
    assert got[-1] == sent[-1]
    assert len(got) + lost == len(sent)
    assert set(got) <= set(sent)


def test_our_own_messages_are_understood_from_the_bag_alone(
    node: Node, recorder: RecorderProcess
) -> None:
    updates = heard(node, MeshDelta, MESH_UPDATES, UPDATES)
    contacts = heard(node, Contact, CONTACT, STREAM)
    displacement = [random.Random(2).random() for _ in range(17_500)]
    updates.publish(MeshDelta(revision=8, base_revision=7, displacement=displacement))
    contacts.publish(Contact(state=Contact.TOUCHING, nodes=[1, 2, 3, 0, 0, 0, 0, 0, 0]))
    time.sleep(0.3)
    recorder.end()
    with AnyReader([recorder.folder]) as reader:
        by_topic = {
            c.topic: reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()
        }
    delta = by_topic['/tissue/mesh_updates']
    assert (delta.revision, delta.base_revision) == (8, 7)
    assert list(delta.displacement) == displacement
    assert list(by_topic['/tool/contact'].nodes) == [1, 2, 3] + [0] * 6


def test_a_latched_message_from_before_the_recorder_is_in_the_bag(
    node: Node, tmp_path: Path
) -> None:
    publisher = node.create_publisher(String, '/latched', LATCHED)
    publisher.publish(String(data='from before'))
    recorder = RecorderProcess(tmp_path / 'bag')
    wait_for(lambda: publisher.get_subscription_count() == 1, 'the recorder')
    time.sleep(0.5)
    recorder.end()
    (message,) = read_topic(recorder.folder, '/latched')
    assert message.data == 'from before'


def test_a_best_effort_publisher_is_recorded_with_the_qos_it_offers(
    node: Node, recorder: RecorderProcess
) -> None:
    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = heard(node, String, '/casual', qos)
    publisher.publish(String(data='hello'))
    time.sleep(0.3)
    recorder.end()
    with AnyReader([recorder.folder]) as reader:
        (connection,) = [c for c in reader.connections if c.topic == '/casual']
        assert connection.ext.offered_qos_profiles[0].reliability.name == 'BEST_EFFORT'
        assert connection.ext.offered_qos_profiles[0].history.name == 'KEEP_LAST'
        assert connection.msgcount == 1


def test_a_state_is_asked_for_only_where_the_inputs_of_frames_arrive(
    node: Node, recorder: RecorderProcess
) -> None:
    state = node.create_publisher(State, TISSUE_STATE, STREAM)
    frames = heard(node, FrameInputs, FRAME_INPUTS, STREAM)
    contacts = heard(node, Contact, CONTACT, STREAM)
    frames.publish(FrameInputs())
    time.sleep(1.0)
    assert state.get_subscription_count() == 0
    contacts.publish(Contact())
    wait_for(lambda: state.get_subscription_count() == 1, 'the recorder to ask for the state')


def test_service_calls_are_recorded_where_introspection_is_on(
    node: Node, recorder: RecorderProcess
) -> None:
    def answer(request: Any, response: Any) -> Any:
        response.success, response.message = request.data, 'cut'
        return response

    service = node.create_service(SetBool, '/do_it', answer)
    service.configure_introspection(
        node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS
    )
    wait_for(lambda: node.count_subscribers('/do_it/_service_event') == 1, 'the recorder')
    client = node.create_client(SetBool, '/do_it')
    assert client.wait_for_service(PATIENCE)
    future = client.call_async(SetBool.Request(data=True))
    wait_for(future.done, 'the service')
    time.sleep(0.3)
    recorder.end()
    events = read_topic(recorder.folder, '/do_it/_service_event')
    assert [event.request[0].data for event in events if event.request] == [True]
    assert [event.response[0].message for event in events if event.response] == ['cut']
    assert len(recorded(recorder.folder, '/do_it/_service_event')) == len(events) == 2


def test_what_a_publisher_sent_before_the_recorder_heard_it_is_said(
    node: Node, tmp_path: Path
) -> None:
    publisher = node.create_publisher(String, '/early', QoSProfile(depth=10))
    for i in range(3):
        publisher.publish(String(data=str(i)))
    recorder = RecorderProcess(tmp_path / 'bag')
    wait_for(lambda: publisher.get_subscription_count() == 1, 'the recorder')
    time.sleep(0.2)
    publisher.publish(String(data='heard'))
    time.sleep(0.3)
    assert '/early: 1 received, 1 written, 0 lost, 3 missed before subscription' in recorder.end()


def test_losses_are_on_diagnostics_and_they_and_all_parameters_are_in_the_bag(
    recorder: RecorderProcess,
) -> None:
    time.sleep(2.5)
    recorder.end()
    parameters = yaml.safe_load(open_bag(recorder.folder).custom_data['parameters'])
    assert parameters['/recorder']['seed'] == 11
    arrays = read_topic(recorder.folder, '/diagnostics')
    status = arrays[-1].status[0]
    values = {pair.key: pair.value for pair in status.values}
    assert status.name == 'recorder'
    assert int(values['received']) >= int(values['written']) > 0
    assert values['lost'] == '0'
    assert int(values['received /diagnostics']) >= int(values['written /diagnostics']) > 0
    assert int(values['bytes']) > 0


def test_record_says_of_each_topic_what_came_was_written_was_lost_and_was_sent_before(
    node: Node, tmp_path: Path
) -> None:
    early = node.create_publisher(String, '/early', LATCHED)
    early.publish(String(data='before'))
    early.publish(String(data='the newest is heard'))
    bag = tmp_path / 'bag'
    command = [sys.executable, '-m', 'cutting_trainer.cli', 'record', '-o', str(bag), '--json']
    recording = subprocess.Popen(
        [*command, '--domain', str(DOMAIN), '--scene', 'block', '--seed', '7'],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_for(lambda: early.get_subscription_count() == 1, 'the recorder')
        stream = heard(node, PoseStamped, '/stream', QoSProfile(depth=1000))
        publish_at_1_khz(stream, poses(500))
        time.sleep(0.5)
        recording.send_signal(signal.SIGINT)
        said, notes = recording.communicate(timeout=PATIENCE)
    finally:
        recording.kill()
    assert recording.returncode == 0, notes
    assert f'recording into {bag}; Ctrl-C ends it' in notes
    account = json.loads(said)
    assert account['bag'] == str(bag) and account['failure'] == ''
    whole = {'received': 500, 'written': 500, 'lost': 0, 'missed': 0}
    assert account['topics']['/stream'] == whole
    assert account['topics']['/early'] == {'received': 1, 'written': 1, 'lost': 0, 'missed': 1}
    described = open_bag(bag).custom_data
    assert described['scene'] == find_scene('block').read_text() and described['seed'] == '7'


def test_a_full_disk_does_not_end_the_recorder_and_the_loss_is_counted_and_said(
    node: Node, recorder: RecorderProcess
) -> None:
    publisher = heard(node, PoseStamped, '/stream', QoSProfile(depth=1000))
    sent = publish_at_1_khz(publisher, poses(300))
    time.sleep(0.5)
    path = recorder.folder / 'bag_0.mcap'
    limit = path.stat().st_size + 100
    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (limit, limit))
    sent += publish_at_1_khz(publisher, poses(700))
    time.sleep(1.5)
    assert recorder.process.poll() is None
    said = recorder.end()
    assert recorder.process.returncode == 1
    written, lost = map(
        int, re.search(r'/stream: 1000 received, (\d+) written, (\d+) lost', said).groups()
    )
    assert written + lost == 1000 and lost > 0
    assert f'failed: recorder: cannot write {path}: File too large: ' in said
    assert repair_bag(recorder.folder).messages > 0
    assert recorded(recorder.folder, '/stream') == sent[:written]


@pytest.mark.parametrize(
    ('parameters', 'complaint'),
    [
        ({'bag': '.'}, 'exists already'),
        ({'bag': ''}, 'parameter "bag" is missing'),
        ({'bag': 'new', 'scene': 'nowhere.yaml'}, 'cannot read the scene'),
    ],
)
def test_a_recorder_that_cannot_work_says_why_and_ends(
    tmp_path: Path, parameters: dict[str, str], complaint: str
) -> None:
    words = [('-p', f'{key}:={value or repr(value)}') for key, value in parameters.items()]
    ended = subprocess.run(
        [
            sys.executable,
            '-m',
            'cutting_trainer.bags.recorder_node',
            '--ros-args',
            *itertools.chain(*words),
        ],
        cwd=tmp_path,
        env=os.environ | {'PYTHONPATH': f'{ROOT}{os.pathsep}{os.environ.get("PYTHONPATH", "")}'},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith('error: ') and complaint in ended.stderr
    assert not (tmp_path / 'new').exists()


def test_a_topic_that_is_found_while_the_topics_are_counted_does_no_harm() -> None:
    class Counter:
        """Of a topic; while it is asked, another thread finds a topic."""

        received = before = 0

        @property
        def lost(self) -> int:
            streams[f'/found_{len(streams)}'] = streams['/first']
            return 0

    streams = {'/first': SimpleNamespace(counter=Counter()), '/second': SimpleNamespace()}
    streams['/second'].counter = streams['/first'].counter
    writer = SimpleNamespace(tally=SimpleNamespace(counts={}), lost={})
    counted = Recorder.accounts(SimpleNamespace(_streams=streams, writer=writer))  # type: ignore[arg-type]
    assert counted.keys() == {'/first', '/second'}
