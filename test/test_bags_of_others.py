"""Bags of other writers, intact or put together: `repair` loses nothing of them, or is not done."""

from pathlib import Path

import pytest
from mcap.writer import Writer

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import mcap_file, open_bag
from cutting_trainer.bags.repair import repair_bag

TEXT = 'int32 data\n'


def written(folder: Path, texts: list[str], **options: bool) -> Path:
    """A bag of 100 messages of one topic on each of some channels, one for every definition."""
    folder.mkdir()
    with (folder / 'bag_0.mcap').open('wb') as file:
        writer = Writer(file, chunk_size=400, **options)
        writer.start(profile='ros2')
        for n, text in enumerate(texts):
            schema = writer.register_schema('std_msgs/msg/Int32', 'ros2msg', text.encode())
            channel = writer.register_channel('/number', 'cdr', schema)
            for i in range(100):
                time = 1 + 100 * n + i
                writer.add_message(channel, time, b'\0\1\0\0' + bytes([i, 0, 0, 0]), time, i + 1)
        if not texts:
            writer.add_message(7, 1, b'', 1)
        writer.finish()
    return folder


@pytest.mark.parametrize('left_out', ['repeat_channels', 'repeat_schemas', 'use_summary_offsets'])
def test_an_intact_file_whose_summary_repeats_no_definitions_keeps_every_message(
    tmp_path: Path, left_out: str
) -> None:
    folder = written(tmp_path / 'bag', [TEXT], **{left_out: False})
    result = repair_bag(folder)
    assert result.messages == 100 and result.lost == result.strangers == 0
    assert len(list(open_bag(folder).messages())) == 100


def test_two_channels_of_a_topic_whose_definitions_mean_the_same_become_one(tmp_path: Path) -> None:
    folder = written(tmp_path / 'bag', [TEXT, f'# a number\n{TEXT}\n'])
    result = repair_bag(folder)
    assert result.messages == 200 and result.lost == 0
    assert len(list(open_bag(folder).messages())) == 200
    assert repair_bag(folder).whole


@pytest.mark.parametrize(
    ('texts', 'words'),
    [
        ([TEXT, 'int32 other\n'], '/number has messages of two types'),
        ([], 'does not define the topics of 1 messages'),
    ],
)
def test_an_intact_file_of_which_messages_would_be_lost_is_left_as_it_was(
    tmp_path: Path, texts: list[str], words: str
) -> None:
    folder = written(tmp_path / 'bag', texts)
    path = mcap_file(folder)
    before = path.read_bytes()
    with pytest.raises(BagError, match=f'{words}.*is as it was'):
        repair_bag(folder)
    assert path.read_bytes() == before
