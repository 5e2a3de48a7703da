"""Claims about bags that need no ROS graph: format, independent reading, crashes, full disks."""

import json
import os
import random
import resource
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from independent_readers import by_rosbags
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_loss import SequenceCounter
from cutting_trainer.bags.message_text import schema_text
from cutting_trainer.bags.metadata import FORMAT_VERSION, read_metadata
from cutting_trainer.bags.reader import Recorded, open_bag
from cutting_trainer.bags.recorded_qos import (
    INFINITE,
    OfferedQos,
    channel_profiles,
    metadata_profiles,
)
from cutting_trainer.bags.repair import repair_bag
from cutting_trainer.bags.writer import BagWriter

SAMPLES = Path(__file__).resolve().parents[1] / 'bags' / 'samples' / 'format_2'

LATCHED = OfferedQos(depth=1, durability='transient_local')
TOPICS = {
    '/pose': ('geometry_msgs/msg/PoseStamped', OfferedQos(depth=1)),
    '/mesh': ('std_msgs/msg/UInt8MultiArray', LATCHED),
    '/cut/_service_event': ('std_srvs/srv/SetBool_Event', OfferedQos()),
}
SILENT = '/never_published'
START = 1_700_000_000_000_000_000


def prefixes() -> list[Path]:
    listed = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return [Path(prefix) for prefix in [*listed, sys.prefix] if prefix]


def type_hash(type_name: str) -> str:
    """RIHS01 hash as the generated description of an installed type has it."""
    package, folder, name = type_name.split('/')
    for prefix in prefixes():
        path = prefix / 'share' / package / folder / f'{name}.json'
        if path.is_file():
            hashes = json.loads(path.read_text())['type_hashes']
            return next(h['hash_string'] for h in hashes if h['type_name'] == type_name)
    raise LookupError(type_name)


def add_topics(writer: BagWriter) -> None:
    for topic, (type_name, profile) in TOPICS.items():
        hashed = type_hash(type_name) if '/msg/' in type_name else ''
        writer.add_topic(topic, type_name, schema_text(type_name), hashed, [profile])
    writer.add_topic(SILENT, 'std_msgs/msg/Empty', schema_text('std_msgs/msg/Empty'), '', [])


def some_messages(count: int, seed: int = 1) -> list[Recorded]:
    """Random payloads, 1 ms apart, the topics in turn."""
    source = random.Random(seed)
    names = list(TOPICS)
    return [
        Recorded(
            topic := names[i % len(names)],
            TOPICS[topic][0],
            START + i * 1_000_000,
            START + i * 1_000_000 - 50_000,
            i // len(names) + 1,
            source.randbytes(source.randrange(4, 300)),
        )
        for i in range(count)
    ]


def write_all(writer: BagWriter, messages: list[Recorded], chunk: int = 50) -> None:
    for i, m in enumerate(messages):
        writer.write(m.topic, m.log_time, m.publish_time, m.data, m.sequence)
        if i % chunk == chunk - 1:
            writer.flush()


@pytest.fixture
def messages() -> list[Recorded]:
    return some_messages(500)


@pytest.fixture
def folder(tmp_path: Path, messages: list[Recorded]) -> Path:
    folder = tmp_path / 'session'
    writer = BagWriter(folder, custom_data={'seed': '7', 'scene': 'name: block\n'})
    add_topics(writer)
    write_all(writer, messages)
    writer.close()
    return folder


def test_an_independent_reader_gets_every_message_byte_for_byte(
    folder: Path, messages: list[Recorded]
) -> None:
    expected = [(m.topic, m.type, m.log_time, m.data) for m in messages]
    assert by_rosbags(folder) == expected


def test_our_reader_gets_all_that_was_written_in_the_order_of_log_times(
    folder: Path, messages: list[Recorded]
) -> None:
    bag = open_bag(folder)
    assert bag.complete
    assert list(bag.messages()) == messages
    assert bag.topics() == {
        **{topic: type_name for topic, (type_name, _) in TOPICS.items()},
        SILENT: 'std_msgs/msg/Empty',
    }
    assert list(bag.messages(['/mesh'])) == [m for m in messages if m.topic == '/mesh']
    assert bag.custom_data == {'seed': '7', 'scene': 'name: block\n'}


def test_messages_that_arrive_out_of_order_are_read_in_the_order_of_log_times(
    tmp_path: Path, messages: list[Recorded]
) -> None:
    shuffled = random.Random(3).sample(messages, len(messages))
    with_disorder = BagWriter(tmp_path / 'bag')
    add_topics(with_disorder)
    write_all(with_disorder, shuffled)
    with_disorder.close()
    assert list(open_bag(tmp_path / 'bag').messages()) == messages


def test_checksums_of_chunks_data_and_summary_hold(folder: Path) -> None:
    with (folder / 'session_0.mcap').open('rb') as file:
        assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > 500


def test_summary_counts_and_indexes_are_those_of_the_messages(
    folder: Path, messages: list[Recorded]
) -> None:
    with (folder / 'session_0.mcap').open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    statistics = summary.statistics
    assert statistics.message_count == len(messages)
    assert statistics.chunk_count == len(summary.chunk_indexes) == 10
    assert statistics.message_start_time == messages[0].log_time
    assert statistics.message_end_time == messages[-1].log_time
    assert all(index.message_index_length > 0 for index in summary.chunk_indexes)
    assert all(index.compression == 'zstd' for index in summary.chunk_indexes)
    assert [index.name for index in summary.metadata_indexes] == ['rosbag2']


def test_file_is_what_rosbag2_expects_of_mcap(folder: Path) -> None:
    with (folder / 'session_0.mcap').open('rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        (record,) = reader.iter_metadata()
    assert summary is not None
    topics = [channel.topic for channel in summary.channels.values()]
    assert len(topics) == len(set(topics))
    for channel in summary.channels.values():
        assert channel.message_encoding == 'cdr'
        schema = summary.schemas[channel.schema_id]
        assert schema.encoding == 'ros2msg'
        assert schema.name.count('/') == 2
        assert set(channel.metadata) == {'offered_qos_profiles', 'topic_type_hash'}
    inner = yaml.safe_load(record.metadata['serialized_metadata'])
    assert inner == read_metadata(folder)


def test_metadata_obeys_the_rules_of_version_9(folder: Path, messages: list[Recorded]) -> None:
    text = (folder / 'metadata.yaml').read_text()
    information = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert information['version'] == 9
    assert information['storage_identifier'] == 'mcap'
    assert information['relative_file_paths'] == ['session_0.mcap']
    assert information['ros_distro'] == 'jazzy'
    assert information['message_count'] == len(messages)
    assert information['starting_time'] == {'nanoseconds_since_epoch': messages[0].log_time}
    duration = messages[-1].log_time - messages[0].log_time
    assert information['duration'] == {'nanoseconds': duration}
    assert isinstance(information['duration']['nanoseconds'], int)
    assert information['compression_format'] == '' == information['compression_mode']
    assert 'null' not in text and '~' not in text
    assert information['files'] == [
        {
            'path': 'session_0.mcap',
            'starting_time': {'nanoseconds_since_epoch': messages[0].log_time},
            'duration': {'nanoseconds': duration},
            'message_count': len(messages),
        }
    ]
    assert all(isinstance(value, str) for value in information['custom_data'].values())
    for entry in information['topics_with_message_count']:
        topic = entry['topic_metadata']
        assert set(topic) == {
            'name',
            'type',
            'serialization_format',
            'offered_qos_profiles',
            'type_description_hash',
        }
        assert topic['serialization_format'] == 'cdr'
        assert entry['message_count'] == sum(m.topic == topic['name'] for m in messages)
        if topic['name'] in TOPICS:
            is_message = '/msg/' in topic['type']
            assert topic['type_description_hash'].startswith('RIHS01_') == is_message
            (profile,) = topic['offered_qos_profiles']
            assert profile['avoid_ros_namespace_conventions'] is False
            words = ('history', 'reliability', 'durability', 'liveliness')
            assert all(profile[word] == profile[word].lower() for word in words)
    assert not list(folder.glob('*.tmp'))


@given(
    st.lists(
        st.builds(
            OfferedQos,
            history=st.sampled_from(['keep_last', 'keep_all']),
            depth=st.integers(0, 1000),
            reliability=st.sampled_from(['reliable', 'best_effort']),
            durability=st.sampled_from(['volatile', 'transient_local']),
            deadline=st.integers(0, INFINITE),
            lifespan=st.integers(0, INFINITE),
            liveliness=st.sampled_from(['automatic', 'manual_by_topic']),
            liveliness_lease_duration=st.integers(0, INFINITE),
        ),
        max_size=3,
    )
)
def test_channel_and_metadata_never_differ_in_qos(profiles: list[OfferedQos]) -> None:
    assert yaml.safe_load(channel_profiles(profiles)) == metadata_profiles(profiles)


def test_an_unlimited_duration_is_written_as_ros_writes_it() -> None:
    (profile,) = metadata_profiles([OfferedQos()])
    assert profile['deadline'] == {'sec': 9223372036, 'nsec': 854775807}


def test_a_bag_is_never_written_over(folder: Path, messages: list[Recorded]) -> None:
    with pytest.raises(BagError, match='exists already'):
        BagWriter(folder)
    assert list(open_bag(folder).messages()) == messages


def test_closing_twice_changes_nothing_and_later_messages_count_as_lost(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'bag')
    add_topics(writer)
    writer.close()
    before = {path: path.read_bytes() for path in (tmp_path / 'bag').iterdir()}
    writer.close()
    writer.write('/pose', START, START, b'late')
    writer.flush()
    assert {path: path.read_bytes() for path in (tmp_path / 'bag').iterdir()} == before
    assert writer.lost == {'/pose': 1}


def test_a_bag_is_readable_from_the_moment_it_is_made(tmp_path: Path) -> None:
    BagWriter(tmp_path / 'bag', custom_data={'seed': '5'})
    bag = open_bag(tmp_path / 'bag')
    assert not bag.complete
    assert list(bag.messages()) == []
    assert bag.custom_data == {'seed': '5'}


@settings(max_examples=40, deadline=None)
@given(keep=st.floats(0, 1))
def test_a_bag_cut_off_anywhere_gives_its_complete_chunks(
    tmp_path_factory: pytest.TempPathFactory, keep: float
) -> None:
    folder = tmp_path_factory.mktemp('cut') / 'bag'
    writer = BagWriter(folder)
    add_topics(writer)
    messages = some_messages(120)
    flushed = [writer.size]
    for i in range(0, 120, 20):
        write_all(writer, messages[i : i + 20], chunk=20)
        flushed.append(writer.size)
    writer.close()
    path = folder / 'bag_0.mcap'
    size = flushed[0] + round(keep * (flushed[-1] - flushed[0]))
    os.truncate(path, size)
    bag = open_bag(folder)
    complete = 20 * sum(end <= size for end in flushed[1:])
    read = list(bag.messages())
    assert not bag.complete
    # A chunk may be whole while its index, written after it, is not.
    assert len(read) in (complete, complete + 20)
    assert read == messages[: len(read)]
    assert set(bag.topics()) == (set(TOPICS) | {SILENT} if read else set())


def test_a_full_disk_ends_the_bag_and_not_the_recorder(
    tmp_path: Path, messages: list[Recorded]
) -> None:
    writer = BagWriter(tmp_path / 'bag')
    add_topics(writer)
    write_all(writer, messages[:200])
    assert writer.failure == ''
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (writer.size + 100, hard))
    try:
        write_all(writer, messages[200:])
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert 'bag_0.mcap' in writer.failure
    assert sum(writer.lost.values()) == 300
    assert writer.tally.messages == 200
    bag = open_bag(tmp_path / 'bag')
    assert not bag.complete
    assert list(bag.messages()) == messages[:200]
    assert read_metadata(tmp_path / 'bag')['message_count'] in (0, 200)


def test_what_is_not_a_bag_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r'no metadata\.yaml'):
        open_bag(tmp_path)
    (tmp_path / 'metadata.yaml').write_text('[1, 2]')
    with pytest.raises(BagError, match='not the metadata of a bag'):
        open_bag(tmp_path)
    for read in (open_bag, repair_bag):
        with pytest.raises(BagError, match='is a file: name the folder'):
            read(tmp_path / 'metadata.yaml')


def test_a_format_to_come_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / 'bag'
    BagWriter(folder, custom_data={'format_version': str(FORMAT_VERSION)}).close()
    assert open_bag(folder).complete
    file = folder / 'metadata.yaml'
    now, later = f"format_version: '{FORMAT_VERSION}'", f"format_version: '{FORMAT_VERSION + 1}'"
    file.write_text(file.read_text().replace(now, later))
    with pytest.raises(BagError, match=f'reads formats up to {FORMAT_VERSION}'):
        open_bag(folder)
    file.write_text(file.read_text().replace(later, now))


def test_a_damaged_byte_in_a_bag_with_an_end_is_found_and_named(folder: Path) -> None:
    path = folder / 'session_0.mcap'
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(BagError, match=r'is damaged .* repair'):
        list(open_bag(folder).messages())
    assert repair_bag(folder).doubtful == 50
    assert len(list(open_bag(folder).messages())) == 500


def installed_types() -> list[str]:
    packages = ('geometry_msgs', 'std_msgs', 'diagnostic_msgs', 'rcl_interfaces', 'sensor_msgs')
    return sorted(
        {
            f'{package}/msg/{path.stem}'
            for prefix in prefixes()
            for package in (*packages, 'cutting_trainer_msgs')
            for path in (prefix / 'share' / package / 'msg').glob('*.msg')
        }
        # rosbags hashes char as another integer than ROS does
        - {'std_msgs/msg/Char'}
    )


def test_schemas_define_the_installed_types_hash_for_hash() -> None:
    types = installed_types()
    assert 'cutting_trainer_msgs/msg/MeshDelta' in types
    for type_name in types:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema_text(type_name), type_name))
        assert store.hash_rihs01(type_name) == type_hash(type_name)


def test_a_type_that_is_not_installed_is_named() -> None:
    with pytest.raises(BagError, match=r'nowhere_msgs/msg/Nothing\.msg'):
        schema_text('nowhere_msgs/msg/Nothing')


@st.composite
def lossy_sequences(draw: st.DrawFn) -> tuple[int, list[int], int]:
    """Publishers, the numbers that came (first and last always do), and how many did not."""
    lengths = draw(st.lists(st.integers(2, 30), min_size=1, max_size=4))
    kept = [
        [1, *sorted(draw(st.sets(st.integers(2, length), max_size=20)) - {length}), length]
        for length in lengths
    ]
    lost = sum(lengths) - sum(map(len, kept))
    order = draw(st.permutations([i for i, numbers in enumerate(kept) for _ in numbers]))
    queues = [iter(numbers) for numbers in kept]
    return len(lengths), [next(queues[i]) for i in order], lost


@given(lossy_sequences())
def test_gaps_are_counted_exactly_for_one_publisher_and_never_too_high_for_several(
    case: tuple[int, list[int], int],
) -> None:
    publishers, numbers, lost = case
    counter = SequenceCounter()
    counter.publishers = publishers
    for number in numbers:
        counter.add(number)
    assert counter.received == len(numbers)
    assert counter.lost == lost if publishers == 1 else counter.lost <= lost


def test_a_gap_among_two_publishers_is_counted_once_both_go_on() -> None:
    counter = SequenceCounter()
    counter.publishers = 2
    for number in (1, 1, 2, 5, 3, 6, 4, 5):
        counter.add(number)
    assert (counter.lost, counter.before) == (3, 0)


@pytest.mark.parametrize('start', [lambda c: None, lambda c: c.add(1)])
def test_what_a_publisher_sent_before_it_was_heard_is_counted_apart(
    start: Callable[[SequenceCounter], None],
) -> None:
    counter = SequenceCounter()
    counter.publishers = 2
    start(counter)
    counter.add(41)
    counter.add(42)
    assert (counter.lost, counter.before) == (0, 40)


def test_a_folder_that_is_no_bag_is_said_to_be_missing_or_to_have_bags_in_it(
    tmp_path: Path,
) -> None:
    for folder, said in (
        (tmp_path / 'none', 'there is no such folder'),
        (tmp_path, r'it has no metadata\.yaml$'),
        (SAMPLES, 'but bags in it: crossing_cuts, palpation, straight_cut'),
    ):
        with pytest.raises(BagError, match=said) as refused:
            open_bag(folder)
        assert str(refused.value).startswith(f'{folder} is not a bag: ')
