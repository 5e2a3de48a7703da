"""What a public reader gets of a damaged bag, `repair` keeps; and hostile bags harm nobody."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.files.commands import READING, run
from bench.files.damaged_bags import KINDS, damage, outcome, small_bag
from bench.files.hostile_bags import HOSTILE_BAGS
from cutting_trainer.bags.integrity_check import flaw
from cutting_trainer.bags.reader import mcap_file, open_bag
from cutting_trainer.bags.repair import repair_bag
from cutting_trainer.cli import bag_commands
from cutting_trainer.recordings import (
    html_report,
    picture,
    repair_command,
    resimulate_command,
)

pytestmark = pytest.mark.long

SAMPLES = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2'
TOPICS = ('/tissue/mesh', '/tissue/mesh_updates', '/tissue/force', '/tool/contact')
COPIES = 64
MAX_MEMORY = 500
"""[MB]"""
LOADED = (bag_commands, html_report, picture, repair_command, resimulate_command)
"""Modules that commands would load: they are no part of what a bag takes."""
HARMLESS = ('a scene', 'a format', 'an attachment', 'metadata without')
"""Kinds of which a command may need nothing."""


@pytest.fixture(scope='module')
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('small') / 'bag'
    return small_bag(SAMPLES / 'palpation', folder, TOPICS, 240, 12)


@pytest.fixture
def copy(small: Path, tmp_path: Path) -> Iterator[Path]:
    yield Path(shutil.copytree(small, tmp_path / 'copy' / 'bag'))
    shutil.rmtree(tmp_path / 'copy')


@pytest.fixture
def scratch(tmp_path: Path) -> Iterator[Path]:
    """Folder whose bags test_every_bag.py does not find."""
    yield tmp_path
    shutil.rmtree(tmp_path)


@pytest.mark.parametrize('seed', range(COPIES // len(KINDS)))
@pytest.mark.parametrize('kind', KINDS)
def test_all_that_public_readers_get_of_a_damaged_bag_is_kept_and_none_refuses_it_then(
    copy: Path, kind: str, seed: int
) -> None:
    damage(copy, kind, seed)
    came = outcome(copy, rosbags=seed == 0)
    assert not came.missing and not came.refused, came


def test_one_bit_in_the_first_chunk_costs_nothing_and_its_messages_are_named_as_doubtful(
    copy: Path,
) -> None:
    path = mcap_file(copy)
    data = bytearray(path.read_bytes())
    data[data.index(b'\x28\xb5\x2f\xfd') + 300] ^= 1
    path.write_bytes(data)
    came = repair_bag(copy)
    assert came.messages + (came.lost or 0) == 240
    assert came.messages >= 228 and (came.doubtful or came.damaged)
    assert len({m.topic for m in open_bag(copy).messages()}) == len(TOPICS)


def test_index_records_that_are_complete_are_not_counted_as_lost(copy: Path) -> None:
    path = mcap_file(copy)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b'\x08', 0, len(data) - 200)])
    came = repair_bag(copy)
    assert came.messages == 240 and came.lost == 0
    assert came.lost_bytes < 100


@pytest.mark.parametrize('name', ['palpation', 'straight_cut', 'crossing_cuts'])
def test_the_samples_are_whole(name: str) -> None:
    assert flaw(SAMPLES / name, mcap_file(SAMPLES / name)) == ''


@pytest.mark.parametrize(
    'kind',
    [
        pytest.param(kind, marks=[] if n % 6 == 0 else pytest.mark.thorough)
        for n, kind in enumerate(HOSTILE_BAGS)
    ],
)
def test_a_hostile_bag_ends_reading_commands_with_one_sentence_in_bounded_memory(
    scratch: Path, kind: str
) -> None:
    turn = list(HOSTILE_BAGS).index(kind) % 3  # two of six commands: each meets every third kind
    for name, arguments in list(READING.items())[turn::3]:
        bag = scratch / name / 'bag'
        HOSTILE_BAGS[kind](bag)
        ended = run(arguments(bag, scratch))
        assert ended.memory < MAX_MEMORY, (name, ended)
        if ended.status == 0 and (name == 'repair' or kind.startswith(HARMLESS)):
            continue
        assert ended.one_sentence, (name, ended)
