"""Repair of a bag that a crash or a disk has damaged: all intact messages are kept."""

import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.integrity_check import flaw
from cutting_trainer.bags.mcap.chunks import ChunkError
from cutting_trainer.bags.mcap.salvage import Salvage, Salvaged
from cutting_trainer.bags.mcap.summary import read_index
from cutting_trainer.bags.metadata import METADATA_FILE, read_metadata
from cutting_trainer.bags.reader import mcap_file
from cutting_trainer.bags.recorded_qos import Profiles, profiles_from
from cutting_trainer.bags.untrusted_yaml import load_yaml, text_by_key
from cutting_trainer.bags.writer import BagWriter

_TEMPORARY = 'repair.tmp'
_OF_BAG = 'rosbag2'
"""Name of the metadata in an MCAP file that repeats metadata.yaml."""
_MAX_SPANS = 100
_REPAIRED = 'repaired'
"""Key in `custom_data` of the result of repairs."""
_MAX_NOTE_LENGTH = 1000
"""Characters of that text."""


@dataclass
class Repair:
    """Result of a repair.

    Attributes:
        whole: the bag was intact, and nothing was changed.
        messages, topics: in the bag now.
        seconds: from its first message to its last [s].
        flaw: the first fault, a sentence.
        lost: number of lost messages; None where the file does not tell it.
        lost_bytes: bytes of the file that were no complete record and no index.
        lost_spans: begin and end of lost parts [s since the first message kept].
        cut_off: of `lost_bytes`, those at the end of the file.
        silence: from the last message kept to the last change of the file [s].
        damaged: number of chunks that could not be read completely.
        doubtful: messages kept from chunks with a wrong checksum: each may be changed.
        repeated: chunks that are in the file more than once; all are kept.
        strangers: messages of undefined topics: lost too.
        repaired: the note of all repairs in the bag, this one included.
    """

    whole: bool = False
    messages: int = 0
    topics: int = 0
    seconds: float = 0.0
    flaw: str = ''
    lost: int | None = 0
    lost_bytes: int = 0
    lost_spans: list[tuple[float, float]] = field(default_factory=list)
    cut_off: int = 0
    silence: float = 0.0
    damaged: int = 0
    doubtful: int = 0
    repeated: int = 0
    strangers: int = 0
    repaired: str = ''

    @property
    def gone(self) -> str:
        """Return the losses, in messages, bytes and time."""
        count = 'an unknown number of' if self.lost is None else str(self.lost)
        text = f'{count} messages, {self.lost_bytes} bytes'
        if self.damaged:
            text += f', {self.damaged} chunks damaged'
        spans = [f'{begin:.2f} to {end:.2f} s' for begin, end in self.lost_spans]
        if spans:
            more = f' and {len(spans) - 3} times more' if len(spans) > 3 else ''
            text += f', from {", ".join(spans[:3])}{more}'
        return text


def repair_note(custom_data: Mapping[str, str]) -> str:
    """Return one sentence about the repairs of a bag, '' where there was none.

    Args:
        custom_data: of the bag.
    """
    said = ' '.join(custom_data.get(_REPAIRED, '').split())[:_MAX_NOTE_LENGTH]
    return f'the bag was repaired: {said}' if said else ''


def repair_bag(folder: Path) -> Repair:
    """Restore the end, the indexes and the metadata of a bag; messages stay bit for bit.

    The bag is written anew beside itself and then replaced: it needs the same space on the disk
    again, and an interrupted repair leaves it unchanged.

    Args:
        folder: of the bag.

    Raises:
        BagError: it is no bag, no message can be read, or the disk is full.
    """
    folder = Path(folder)
    path = mcap_file(folder)
    with _temporary(folder) as temporary:
        wrong = flaw(folder, path)
        if not wrong:
            said = text_by_key(read_metadata(folder).get('custom_data'), str(folder))
            return Repair(whole=True, repaired=repair_note(said))
        modified = path.stat().st_mtime
        with Salvage(path) as salvage:
            data = _custom_data(folder, salvage)
            writer = BagWriter(temporary / folder.resolve().name, custom_data=data)
            result, refused = _write(salvage, writer)
            stated = salvage.summary is not None and salvage.summary.messages is not None
            if not stated and result.lost == 0 and not result.repeated:
                result.lost = max(_promised(folder) - writer.tally.messages, 0)
        result.flaw = wrong
        start = writer.tally.start
        result.lost_spans = [((a - start) * 1e-9, (b - start) * 1e-9) for a, b in result.lost_spans]
        data[_REPAIRED] = _noted(data.get(_REPAIRED, ''), result)
        result.repaired = repair_note(data)
        writer.describe(**{_REPAIRED: data[_REPAIRED]})
        writer.close()
        if refused := writer.failure or refused:
            raise BagError(f'{refused}: {folder} is as it was')
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


def _promised(folder: Path) -> int:
    """Return how many messages the metadata of a bag name; 0: they name none."""
    try:
        count = read_metadata(folder).get('message_count')
    except BagError:
        return 0
    return count if isinstance(count, int) else 0


def _noted(before: str, result: Repair) -> str:
    """Return the note of all repairs for the bag: nothing else in it tells the doubtful parts."""
    doubtful = f'; to be doubted: {result.doubtful} messages' if result.doubtful else ''
    now = f'{result.flaw[:200]}; gone: {result.gone}{doubtful}'
    return (f'{before}; then {now}' if before else now)[-_MAX_NOTE_LENGTH:]


def copy_bag(source: Path, target: Path, *, since: int = 0, without: Collection[str] = ()) -> None:
    """Copy a bag, in as few chunks as possible, its messages bit for bit.

    Args:
        source: folder of the bag.
        target: folder of the new one.
        since: smallest log time to be copied [ns since the epoch].
        without: topics to be left out.

    Raises:
        BagError: it is not a bag, or the new one cannot be written.
    """
    with Salvage(mcap_file(source)) as salvage:
        writer = BagWriter(target, custom_data=_custom_data(source, salvage))
        _define(salvage, writer, without)
        for chunk in salvage.chunks():
            for channel, m in chunk.messages:
                if m.log_time >= since and channel.topic not in without:
                    writer.write(channel.topic, m.log_time, m.publish_time, m.data, m.sequence)
    writer.close()
    if writer.failure:
        raise BagError(writer.failure)


def _write(salvage: Salvage, writer: BagWriter) -> tuple[Repair, str]:
    """Write all messages that can be read, and account for the rest; times in ns since the epoch.

    Returns:
        The result; why the bag must be left unchanged, '' otherwise.
    """
    result = Repair()
    types = _define(salvage, writer)
    kept, counted, known = 0, 0, True
    before, refused = 0, ''
    sound = salvage.summary is not None and not (salvage.summary.flaw or salvage.gaps)
    for part in salvage.chunks():
        other = _copy(part, writer, types)
        sound = sound and not (part.damaged or part.doubtful)
        if other and not (part.damaged or part.doubtful):
            refused = f'{other[:80]} has messages of two types in {salvage.path}'
        result.damaged += part.damaged
        result.repeated += part.repeated
        result.strangers += part.strangers
        result.doubtful += len(part.messages) if part.doubtful else 0
        if part.damaged:
            result.lost_bytes += part.end - part.offset
            result.cut_off += part.end - part.offset if part.end == salvage.size else 0
            _note(result, part.start or before, part.stop or before)
        if not part.repeated:
            kept += len(part.messages)
            known = known and part.lost is not None
            counted += part.lost or 0
        before = max([before, *(m.log_time for _, m in part.messages)])
    for begin, end in salvage.gaps:
        result.lost_bytes += end - begin
        result.cut_off += end - begin if end == salvage.size else 0
    stated = salvage.summary.messages if salvage.summary is not None else None
    if stated is not None:
        result.lost = max(stated - kept, 0)
    else:
        result.lost = counted if known and not salvage.gaps else None
    for attached in salvage.bodies(Opcode.ATTACHMENT):
        _attach(writer, attached)
    if not refused and sound and result.strangers:
        refused = f'{salvage.path} does not define the topics of {result.strangers} messages'
    gone = result.lost_bytes or result.damaged or result.strangers or result.lost
    if not refused and gone and not writer.tally.messages:
        refused = f'{salvage.path} has no chunk that is whole'
    return result, refused


def _note(result: Repair, start: int, stop: int) -> None:
    """Add the time span of a loss; touching spans become one."""
    spans = result.lost_spans
    if not stop:
        return
    if spans and spans[-1][1] >= start >= spans[-1][0]:
        spans[-1] = (spans[-1][0], max(stop, spans[-1][1]))
    elif len(spans) < _MAX_SPANS:
        spans.append((start, stop))


def _define(
    salvage: Salvage, writer: BagWriter, without: Collection[str] = ()
) -> dict[str, set[int]]:
    """Add the topics of a file to a writer; return the numbers of their definitions.

    A bag merged from others may have a topic, and its definition, more than once.
    """
    types: dict[str, set[int]] = {}
    first: dict[str, tuple[str, str, list[str]]] = {}
    for channel in salvage.channels.values():
        schema = salvage.schemas.get(channel.schema_id)
        if schema is None or channel.topic in without:
            continue
        meaning = _meaning(schema)
        if first.setdefault(channel.topic, meaning) == meaning:
            types.setdefault(channel.topic, set()).add(schema.id)
        if channel.topic in writer.topics:
            continue
        writer.add_topic(
            channel.topic,
            schema.name,
            schema.data.decode(),
            channel.metadata.get('topic_type_hash', ''),
            _profiles(channel),
        )
    return types


def _meaning(schema: Schema) -> tuple[str, str, list[str]]:
    """Return a definition without comments and blanks, to compare two of one type."""
    lines = (line.partition('#')[0].split() for line in schema.data.decode().splitlines())
    return schema.name, schema.encoding, [' '.join(words) for words in lines if words]


def _profiles(channel: Channel) -> Profiles:
    try:
        return profiles_from(channel.metadata.get('offered_qos_profiles', ''))
    except BagError:  # damaged: use the QoS that is compatible with any publisher
        return ()


def _copy(part: Salvaged, writer: BagWriter, types: dict[str, set[int]]) -> str:
    """Write the messages of a part; return a topic whose messages have another type."""
    kept, other = [], ''
    for channel, m in part.messages:
        if channel.schema_id in types[channel.topic]:
            writer.write(channel.topic, m.log_time, m.publish_time, m.data, m.sequence)
            kept.append((channel, m))
        else:
            part.strangers += 1
            other = channel.topic
    part.messages = kept
    writer.flush()
    return other


def _attach(writer: BagWriter, body: bytes) -> None:
    try:
        writer.attach(read_index(Attachment, body))
    except ChunkError:
        return


def _custom_data(folder: Path, salvage: Salvage) -> dict[str, str]:
    """Return the recorder's data on a session: from metadata.yaml, or else from the file itself."""
    where = f'custom_data of {folder / METADATA_FILE}'
    try:
        return text_by_key(read_metadata(folder).get('custom_data'), where)
    except BagError:
        pass
    for body in salvage.bodies(Opcode.METADATA):
        try:
            record = read_index(Metadata, body)
            if record.name == _OF_BAG:
                said = load_yaml(record.metadata.get('serialized_metadata', ''), where)
                return text_by_key(said.get('custom_data'), where)
        except (BagError, AttributeError):
            continue
    return {}


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
