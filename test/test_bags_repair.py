"""A bag that was cut off or damaged becomes whole again, with all that can be read in it."""

import json
import os
import resource
from pathlib import Path

import pytest
from independent_readers import by_rosbags
from mcap.opcode import Opcode
from mcap.reader import make_reader
from test_bags import add_topics, some_messages, write_all

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.mcap.chunks import MESSAGE_HEAD, Unpacked
from cutting_trainer.bags.mcap.damaged_chunk import behind, prefix
from cutting_trainer.bags.mcap.records import HEAD
from cutting_trainer.bags.metadata import read_metadata
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.repair import repair_bag, repair_note
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.recordings.repair_command import account_lines, repair

pytestmark = pytest.mark.long

MESSAGES = some_messages(500)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    writer = BagWriter(tmp_path / 'session', custom_data={'seed': '7'})
    add_topics(writer)
    write_all(writer, MESSAGES)
    writer.close()
    return tmp_path / 'session'


def cut(folder: Path, size: int) -> Path:
    path = folder / 'session_0.mcap'
    os.truncate(path, size)
    return path


def test_a_whole_bag_is_left_alone(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert repair_bag(folder).whole
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_bag_cut_off_is_whole_again_with_its_complete_chunks_for_every_reader(
    folder: Path,
) -> None:
    size = (folder / 'session_0.mcap').stat().st_size
    cut(folder, size * 6 // 10)
    result = repair_bag(folder)
    bag = open_bag(folder)
    kept = list(bag.messages())
    assert bag.complete and bag.custom_data['seed'] == '7'
    assert 200 < len(kept) == result.messages < 500
    assert kept == MESSAGES[: len(kept)]
    assert by_rosbags(folder) == [(m.topic, m.type, m.log_time, m.data) for m in kept]
    assert read_metadata(folder)['message_count'] == len(kept)
    assert result.cut_off > 0 and str(result.cut_off) in '\n'.join(account_lines(folder, result))
    assert sorted(path.name for path in folder.iterdir()) == ['metadata.yaml', 'session_0.mcap']
    assert repair_bag(folder).whole


def test_messages_that_were_cut_off_with_whole_chunks_are_counted_by_the_metadata(
    folder: Path,
) -> None:
    with (folder / 'session_0.mcap').open('rb') as file:
        begins = [c.chunk_start_offset for c in make_reader(file).get_summary().chunk_indexes]
    cut(folder, sorted(begins)[-1])  # its last chunk, and all behind it
    result = repair_bag(folder)
    assert 0 < result.messages < 500
    assert result.lost == 500 - result.messages
    assert f'gone: {result.lost} messages' in open_bag(folder).custom_data['repaired']


def test_qos_and_hashes_survive_a_repair(folder: Path) -> None:
    before = read_metadata(folder)['topics_with_message_count']
    cut(folder, (folder / 'session_0.mcap').stat().st_size - 10)
    repair_bag(folder)
    assert read_metadata(folder)['topics_with_message_count'] == before


def test_a_damaged_chunk_in_the_middle_is_kept_as_far_as_it_unpacks_and_named_as_doubtful(
    folder: Path,
) -> None:
    path = folder / 'session_0.mcap'
    data = bytearray(path.read_bytes())
    for i in range(len(data) // 2, len(data) // 2 + 64):
        data[i] ^= 0xFF
    path.write_bytes(bytes(data[:-20]))
    result = repair_bag(folder)
    assert result.doubtful == 50 and result.lost == 0
    kept = list(open_bag(folder).messages())
    assert len(kept) == 500 and sum(m in kept for m in MESSAGES) >= 450
    assert any('50 messages' in line for line in account_lines(folder, result))
    again = repair_bag(folder)
    assert again.whole and 'to be doubted: 50 messages' in account_lines(folder, again)[1]
    assert 'doubted: 50 messages' in repair_note(open_bag(folder).custom_data)


def test_a_chunk_that_cannot_be_unpacked_costs_its_own_messages_only(folder: Path) -> None:
    path = folder / 'session_0.mcap'
    data = bytearray(path.read_bytes())
    at = data.index(b'\x28\xb5\x2f\xfd', len(data) // 2)
    data[at : at + 4] = b'----'
    path.write_bytes(bytes(data))
    result = repair_bag(folder)
    assert result.damaged == 1 and result.doubtful == 0 and result.lost == 50
    assert len(result.lost_spans) == 1
    kept = list(open_bag(folder).messages())
    assert len(kept) == 450
    assert [m for m in MESSAGES if m in kept] == kept
    assert any('50 messages' in line for line in account_lines(folder, result))


def test_messages_whose_lengths_are_damaged_end_where_the_index_has_the_next_one() -> None:
    told, body = HEAD.pack(Opcode.MESSAGE, 8602), MESSAGES[0].data
    times = [1000 + k for k in range(10)]
    records = [told + MESSAGE_HEAD.pack(3, k, time, time) + body for k, time in enumerate(times)]
    counted = [(3, time, k * len(records[0])) for k, time in enumerate(times)]
    data = b''.join(records)
    assert prefix(data) == ([], False)
    whole = behind(Unpacked(data, complete=True, checked=False, wrong=True), counted, [])
    assert [(m.log_time, m.data) for m in whole] == [(time, body) for time in times]
    part = behind(Unpacked(data[:-3], complete=False, checked=False, wrong=True), counted, [])
    assert [m.log_time for m in part] == times[:-1]


def test_a_bag_of_which_nothing_can_be_saved_stays_as_it_was(folder: Path) -> None:
    before = cut(folder, 60).read_bytes()
    with pytest.raises(BagError, match='no chunk that is whole'):
        repair_bag(folder)
    assert (folder / 'session_0.mcap').read_bytes() == before


def test_a_bag_without_metadata_gets_it_back(folder: Path) -> None:
    (folder / 'metadata.yaml').unlink()
    assert not repair_bag(folder).whole
    assert read_metadata(folder)['message_count'] == 500


def test_where_there_is_no_room_the_bag_stays_as_it_was(folder: Path) -> None:
    path = cut(folder, (folder / 'session_0.mcap').stat().st_size - 10)
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
    try:
        with pytest.raises(BagError, match='is as it was'):
            repair_bag(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert sorted(p.name for p in folder.iterdir()) == ['metadata.yaml', 'session_0.mcap']


def test_json_counts_what_is_lost_and_names_it_by_topic_beside(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / 'session_0.mcap'
    data = bytearray(path.read_bytes())
    at = data.index(b'\x28\xb5\x2f\xfd', len(data) // 2)
    data[at : at + 4] = b'----'
    path.write_bytes(bytes(data))
    repair(folder, as_json=True)
    plain = json.loads(capsys.readouterr().out)
    assert plain['lost'] == 50 == sum(plain['lost_by_sequence'].values())
