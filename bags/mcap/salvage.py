"""Recovery of all readable messages of a damaged MCAP file: cut off, changed, with gaps.

Every record is searched: by the summary's index, sequentially, and, where that fails, by the
pattern of a record's head.
"""

from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from mcap.opcode import Opcode
from mcap.records import Channel, Message, MessageIndex, Schema

from cutting_trainer.bags.mcap.chunks import (
    MAX_CHUNK,
    MAX_RECORDS,
    ChunkError,
    McapRecord,
    UnpackBudget,
    read_chunk,
    read_record,
    unpack,
)
from cutting_trainer.bags.mcap.damaged_chunk import CHUNK_HEAD, behind, inner_length, opened, prefix
from cutting_trainer.bags.mcap.records import HEAD, INDEX_OPCODES, MAGIC, McapFile, RecordPlace
from cutting_trainer.bags.mcap.summary import read_index, read_summary

_MAX_TRIES = 4
"""Offsets within a damaged chunk at which the next chunk is searched."""
_MAX_SPECULATIVE_BYTES = 1 << 30
"""Bytes, and 16 for each of the file, that may be unpacked to test for a chunk."""
_PRIVATE_OPCODES = 0x80
"""Smallest opcode of private records."""


@dataclass
class Salvaged:
    """Messages recovered from a part of a file: a chunk, or messages outside of any.

    Attributes:
        offset, end: of the part in the file [bytes].
        start, stop: smallest and largest log time in its head, zeros where there is none.
        damaged: a part of it could not be read.
        doubtful: its checksum is wrong: a message in it may have changed.
        repeated: the file has the same chunk before.
        messages: with their channels, in the order of the file.
        strangers: messages of unknown channels.
        expected: number of messages by its indexes; None without them.
    """

    offset: int
    end: int
    start: int = 0
    stop: int = 0
    damaged: bool = False
    doubtful: bool = False
    repeated: bool = False
    messages: list[tuple[Channel, Message]] = field(default_factory=list)
    strangers: int = 0
    expected: int | None = None

    @property
    def lost(self) -> int | None:
        """Return the number of lost messages; None where it is unknown."""
        if not (self.damaged or self.strangers):
            return 0
        return None if self.expected is None else max(self.expected - len(self.messages), 0)


class Salvage:
    """Reads a damaged file; a context manager.

    Args:
        path: the file.

    Attributes:
        summary: at its end, None where there is none.
        schemas, channels: by number: from the summary where its checksum is right, then from chunks
            with a right checksum, then from all others.
        gaps: begin and end of damaged ranges [bytes] that may have had messages.
    """

    def __init__(self, path: Path) -> None:
        self._file = McapFile(path)
        self.summary = read_summary(self._file)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.gaps: list[tuple[int, int]] = []
        hints = self.summary.chunks if self.summary else []
        self._hints = {chunk.offset: chunk.length for chunk in hints}
        self._hinted = sorted(self._hints)
        self._speculation = _MAX_SPECULATIVE_BYTES + 16 * self._file.size
        self._room = UnpackBudget(self._file.path, self._file.size)
        self._found = array('Q')
        for place in self._find():
            kept = place.opcode == Opcode.METADATA or place.opcode not in INDEX_OPCODES
            if kept and place.opcode < _PRIVATE_OPCODES:
                self._found.extend(place)
        self._define()

    def __enter__(self) -> 'Salvage':
        return self

    def __exit__(
        self, kind: type[BaseException] | None, e: BaseException | None, at: TracebackType | None
    ) -> None:
        self._file.__exit__(kind, e, at)

    @property
    def path(self) -> Path:
        """Return the path of the file."""
        return self._file.path

    @property
    def size(self) -> int:
        """Return the size of the file [bytes]."""
        return self._file.size

    def chunks(self) -> Iterator[Salvaged]:
        """Yield the recovered parts, in the order of the file.

        Raises:
            BagError: it unpacks to more than a bag of its size can.
        """
        self._room = UnpackBudget(self._file.path, self._file.size)
        known: set[int] = set()
        for place in self._places():
            if place.opcode == Opcode.CHUNK:
                part = self._salvage_chunk(place, self._counted(place))
                body = hash(self._file.body(place))
                part.repeated = body in known
                known.add(body)
                yield part
            elif place.opcode == Opcode.MESSAGE:
                part = Salvaged(place.offset, place.end, expected=1)
                found = _record(place.opcode, self._file.body(place))
                part.damaged = not found
                self._take(part, found)
                yield part

    def bodies(self, opcode: int) -> Iterator[bytes]:
        """Yield the bodies of all records of a kind outside of chunks."""
        for place in self._places():
            if place.opcode == opcode:
                yield self._file.body(place)

    def _places(self) -> Iterator[RecordPlace]:
        for i in range(0, len(self._found), 3):
            yield RecordPlace(*self._found[i : i + 3])

    def _find(self) -> Iterator[RecordPlace]:
        """Yield the places of records, and of damaged chunks with their probable extent."""
        at, file = len(MAGIC), self._file
        while at < file.size:
            place = file.record(at)
            if (chunk := self._chunk_at(at, place)) is not None:
                yield chunk
                at = chunk.end
            elif place is not None and place.opcode != Opcode.CHUNK and self._follows(place):
                yield place
                at = place.end
            elif file.read(at, len(MAGIC)) == MAGIC:
                at += len(MAGIC)
            else:
                at = self._skip(at)

    def _follows(self, place: RecordPlace) -> bool:
        """Return whether a record is followed by another, the end, or nothing, or is valid."""
        at = place.end
        return (
            at == self._file.size
            or self._file.record(at) is not None
            or self._file.read(at, len(MAGIC)) == MAGIC
            or (place.opcode in INDEX_OPCODES and place.length < 1 << 16)
        )

    def _skip(self, at: int) -> int:
        """Add a gap, and return its end."""
        file, end = self._file, self._resumes(at + 1)
        head = file.read(at, HEAD.size)
        cut_off = end == file.size and len(head) and head[0] in INDEX_OPCODES
        if not cut_off:
            self.gaps.append((at, end))
        return end

    def _resumes(self, at: int) -> int:
        """Return the next offset at which a record or chunk seems to begin."""
        end = self._file.next_place(at)
        if (next_hint := bisect_right(self._hinted, at - 1)) < len(self._hinted):
            end = min(end, self._hinted[next_hint])
        return self._next_chunk(at, end)

    def _chunk_at(self, at: int, place: RecordPlace | None) -> RecordPlace | None:
        """Return the chunk at an offset, intact or not; None where there is none."""
        head = self._file.read(at, HEAD.size + 80)
        inner = inner_length(head[HEAD.size :])
        like = place is not None and place.length == inner
        by_name = head[:1] == bytes([Opcode.CHUNK]) and (place or CHUNK_HEAD.match(head))
        if not (like or by_name or at in self._hints):
            return None
        lengths = [place.length] if place is not None else []
        lengths += [n for n in (inner, self._hints.get(at, 0) - HEAD.size) if n and n > 0]
        lengths = [n for n in dict.fromkeys(lengths) if at + HEAD.size + n <= self._file.size]
        for length in lengths:
            if self._is_sound(RecordPlace(at, Opcode.CHUNK, length)):
                return RecordPlace(at, Opcode.CHUNK, length)
        return self._damaged_chunk(at, lengths) if like or by_name else None

    def _damaged_chunk(self, at: int, lengths: list[int]) -> RecordPlace:
        """Return a damaged chunk.

        It ends at the next intact one, or at its stated length.
        """
        file, begin = self._file, at + HEAD.size
        for length in lengths:
            end = begin + length
            if end == file.size or file.record(end) is not None:
                inside = self._sound_inside(begin, end)
                return RecordPlace(at, Opcode.CHUNK, (end if inside is None else inside) - begin)
        return RecordPlace(at, Opcode.CHUNK, self._resumes(begin) - begin)

    def _sound_inside(self, begin: int, end: int) -> int | None:
        at = begin
        for _ in range(_MAX_TRIES):
            at = self._next_chunk(at, end)
            if at >= end:
                return None
            place = self._file.record(at)
            if place is not None and self._is_sound(place):
                return at
            at += 1
        return None

    def _next_chunk(self, at: int, end: int) -> int:
        """Return the offset of the next head of a chunk; the end where there is none."""
        window = 1 << 20
        while at < end:
            match = CHUNK_HEAD.search(self._file.read(at, min(window + 64, end - at)))
            if match:
                return at + match.start()
            at += window
        return end

    def _is_sound(self, place: RecordPlace) -> bool:
        if self._speculation < 0 or place.length > MAX_CHUNK:
            return False
        try:
            chunk = read_chunk(self._file.body(place))
            self._speculation -= place.length
            unpacked = unpack(chunk)
        except ChunkError:
            return False
        self._speculation -= len(unpacked.data)
        whole = len(chunk.data) + 40 + len(chunk.compression) == place.length
        return whole and unpacked.complete and not unpacked.wrong

    def _define(self) -> None:
        """Collect definitions, the most reliable first."""
        doubtful: list[McapRecord] = []
        if self.summary is not None and self.summary.checked and not self.summary.flaw:
            self._know([*self.summary.schemas.values(), *self.summary.channels.values()])
            if self._summary_defines_all():
                return
        for place in self._places():
            if place.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                found = _record(place.opcode, self._file.body(place))
                self._know(found)
            elif place.opcode == Opcode.CHUNK:
                _, unpacked = opened(self._file.body(place))
                if unpacked is None:
                    continue
                self._room.take(unpacked)
                sound = unpacked.complete and not unpacked.wrong
                found = [r for r in prefix(unpacked.data)[0] if not isinstance(r, Message)]
                self._know(found) if sound else doubtful.extend(found)
        if self.summary is not None:
            self._know([*self.summary.schemas.values(), *self.summary.channels.values()])
        self._know(doubtful)

    def _summary_defines_all(self) -> bool:
        """Return whether the summary has every definition that its chunks use."""
        chunks = self.summary.chunks if self.summary else []
        used = [self.channels.get(number) for chunk in chunks for number in chunk.channels]
        complete = chunks and all(chunk.channels for chunk in chunks)
        return bool(complete) and all(c is not None and c.schema_id in self.schemas for c in used)

    def _know(self, found: list[McapRecord]) -> None:
        for record in found:
            if isinstance(record, Schema):
                self.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self.channels.setdefault(record.id, record)

    def _counted(self, chunk: RecordPlace) -> list[tuple[int, int, int]] | None:
        """Return channel, log time and place of a chunk's messages, by the indexes behind it."""
        entries: list[tuple[int, int, int]] = []
        found = False
        for place in self._file.records(chunk.end, self._file.size):
            if place.opcode != Opcode.MESSAGE_INDEX or len(entries) > MAX_RECORDS:
                break
            try:
                listed = read_index(MessageIndex, self._file.body(place))
            except ChunkError:
                return None
            found = True
            entries += [(listed.channel_id, time, at) for time, at in listed.records]
        return entries if found else None

    def _salvage_chunk(
        self, place: RecordPlace, counted: list[tuple[int, int, int]] | None
    ) -> Salvaged:
        chunk, unpacked = opened(self._file.body(place))
        part = Salvaged(place.offset, place.end, expected=None if counted is None else len(counted))
        if chunk is not None and chunk.message_start_time <= chunk.message_end_time:
            part.start, part.stop = chunk.message_start_time, chunk.message_end_time
        if unpacked is None:
            part.damaged = True
            return part
        self._room.take(unpacked)
        found, whole = prefix(unpacked.data)
        part.doubtful = unpacked.wrong or not whole
        part.damaged = not (whole and unpacked.complete)
        if part.damaged:
            if not unpacked.complete:  # messages that no other reader returns must be likely
                found = [m for m in found if _is_likely(m, part)]
            found += behind(unpacked, counted or [], found)
        self._take(part, found)
        return part

    def _take(self, part: Salvaged, found: Iterable[McapRecord | None]) -> None:
        for record in found:
            if isinstance(record, Message):
                channel = self.channels.get(record.channel_id)
                if channel is not None and channel.schema_id in self.schemas:
                    part.messages.append((channel, record))
                else:
                    part.strangers += 1


def _record(opcode: int, body: bytes) -> list[McapRecord]:
    try:
        record = read_record(opcode, body)
    except ChunkError:
        return []
    return [] if record is None else [record]


def _is_likely(record: McapRecord, part: Salvaged) -> bool:
    """Return whether the log time of a message is within those of its chunk."""
    return not (isinstance(record, Message) and part.stop) or (
        part.start <= record.log_time <= part.stop
    )
