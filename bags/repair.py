"""A bag that a crash or a full disk has cut off becomes whole again, without what is gone."""

import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bags.errors import BagError
from bags.metadata import METADATA_FILE, read_metadata
from bags.qos import profiles_from
from bags.reader import Bag, Salvaged, mcap_file, open_bag, salvage
from bags.writer import BagWriter

_TEMPORARY = 'repair.tmp'


@dataclass
class Repair:
    """What a repair found and did.

    Attributes:
        whole: nothing was wrong, and nothing was done.
        messages, topics: in the bag now.
        seconds: from its first message to its last [s].
        cut_off: bytes after the last complete chunk: what they held is gone.
        silence: from the last message kept to the last change of the file [s].
        damaged: chunks of which the checksum did not hold: what they held is gone.
        strangers: messages of topics that only a damaged chunk defined: gone too.
    """

    whole: bool = False
    messages: int = 0
    topics: int = 0
    seconds: float = 0.0
    cut_off: int = 0
    silence: float = 0.0
    damaged: int = 0
    strangers: int = 0


def repair_bag(folder: Path) -> Repair:
    """Gives a bag its end, its indexes and its metadata back; what is in it stays bit for bit.

    The bag is written anew beside itself and then put in its own place: it needs as much room on
    the disk again, and an interrupted repair leaves it as it was.

    Args:
        folder: of the bag.

    Raises:
        BagError: it is no bag, nothing in it can be saved, or there is no room.
    """
    folder = Path(folder)
    path = mcap_file(folder)
    result = Repair(cut_off=path.stat().st_size)
    with _temporary(folder) as temporary:
        if _is_whole(folder):
            return Repair(whole=True)
        writer = BagWriter(temporary / folder.resolve().name, custom_data=_custom_data(folder))
        for chunk in salvage(path):
            _copy(chunk, writer)
            writer.flush()
            result.cut_off = path.stat().st_size - chunk.end
            result.damaged += chunk.damaged
            result.strangers += chunk.strangers
        modified = path.stat().st_mtime
        writer.close()
        if writer.failure:
            raise BagError(f'{writer.failure}: {folder} is as it was')
        if (result.cut_off or result.damaged) and not writer.tally.messages:
            raise BagError(f'{path} has no chunk that is whole: {folder} is as it was')
        written = writer.folder / f'{folder.resolve().name}_0.mcap'
        written.replace(folder / written.name)
        if path.name != written.name:
            path.unlink()
        (writer.folder / METADATA_FILE).replace(folder / METADATA_FILE)
    tally = writer.tally
    result.messages, result.topics = tally.messages, len(writer.topics)
    result.seconds = (tally.end - tally.start) * 1e-9
    result.silence = max(modified - tally.end * 1e-9, 0.0) if tally.end else 0.0
    return result


def copy_bag(source: Path, target: Path, *, since: int = 0, without: Collection[str] = ()) -> None:
    """Writes a whole bag once more, as few chunks as it takes, its messages bit for bit.

    Args:
        source: folder of the bag.
        target: folder of the new one.
        since: smallest log time to be copied [ns since the epoch].
        without: topics to be left out.

    Raises:
        BagError: it is not a bag, or the new one cannot be written.
    """
    writer = BagWriter(target, custom_data=_custom_data(source))
    for chunk in salvage(mcap_file(source)):
        chunk.channels = [c for c in chunk.channels if c.topic not in without]
        chunk.messages = [
            (c, m) for c, m in chunk.messages if m.log_time >= since and c.topic not in without
        ]
        _copy(chunk, writer)
    writer.close()
    if writer.failure:
        raise BagError(writer.failure)


def _is_whole(folder: Path) -> bool:
    """Whether every chunk can be read through the index, and metadata.yaml says how many."""
    try:
        count = read_metadata(folder)['message_count']
        bag: Bag = open_bag(folder)
        return bag.complete and sum(1 for _ in bag.messages()) == count
    except Exception:  # whatever the damage makes a parser say
        return False


def _custom_data(folder: Path) -> dict[str, str]:
    try:
        return dict(read_metadata(folder).get('custom_data') or {})
    except BagError:
        return {}


def _copy(chunk: Salvaged, writer: BagWriter) -> None:
    for channel in chunk.channels:
        schema = chunk.schemas[channel.schema_id]
        writer.add_topic(
            channel.topic,
            schema.name,
            schema.data.decode(),
            channel.metadata.get('topic_type_hash', ''),
            profiles_from(channel.metadata.get('offered_qos_profiles', '')),
        )
    for channel, m in chunk.messages:
        writer.write(channel.topic, m.log_time, m.publish_time, m.data, m.sequence)


@contextmanager
def _temporary(folder: Path) -> Iterator[Path]:
    temporary = folder / _TEMPORARY
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir()
    except OSError as error:
        raise BagError(f'cannot repair {folder}: {error.strerror}') from None
    try:
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
