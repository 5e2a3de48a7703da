"""Bounded access to the records of an MCAP file, with resynchronisation behind damage."""

import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from mcap.opcode import Opcode

from cutting_trainer.bags.mcap.chunks import MAX_CHUNK, MAX_DEFINITION, MAX_RECORDS

MAGIC = b'\x89MCAP0\r\n'
HEAD = struct.Struct('<BQ')
FOOTER = struct.Struct('<QQI')
_END = HEAD.size + FOOTER.size + len(MAGIC)
_WINDOW = 1 << 20
_MAX_LENGTHS = {
    Opcode.CHUNK: MAX_CHUNK + 1024,
    Opcode.MESSAGE: MAX_CHUNK,
    Opcode.SCHEMA: MAX_DEFINITION,
    Opcode.CHANNEL: MAX_DEFINITION,
    Opcode.MESSAGE_INDEX: 16 * MAX_RECORDS + 6,
    Opcode.ATTACHMENT: 1 << 40,
    Opcode.METADATA: 1 << 24,
}
"""Bytes of a record; of all others `MAX_DEFINITION`. Attachments are skipped, not read."""
_MIN_LENGTHS: dict[int, int] = {
    Opcode.CHUNK: 40,
    Opcode.MESSAGE: 22,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
}
_KNOWN = frozenset(Opcode)
_PRIVATE_OPCODES = 0x80
"""Smallest opcode of private records: they are skipped."""
_LIKE_A_HEAD = re.compile(rb'(?=[\x01-\x0f][\x00-\xff]{5}\x00{3})')
INDEX_OPCODES = frozenset(
    {
        *(Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS),
        *(Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.DATA_END, Opcode.FOOTER),
        *(Opcode.HEADER, Opcode.METADATA),
    }
)
"""Records without messages."""


class RecordPlace(NamedTuple):
    """A record in a file.

    Attributes:
        offset: of its first byte.
        opcode: its kind.
        length: of its body, behind the head.
    """

    offset: int
    opcode: int
    length: int

    @property
    def body(self) -> int:
        """Return the offset of its body."""
        return self.offset + HEAD.size

    @property
    def end(self) -> int:
        """Return the offset of the next record."""
        return self.body + self.length


@dataclass(frozen=True)
class Footer:
    """The end of a file.

    Attributes:
        place: of its record.
        summary_start: offset of the summary, 0 where there is none.
        summary_crc: of the summary up to itself, 0 where it is not given.
    """

    place: RecordPlace
    summary_start: int
    summary_crc: int


class McapFile:
    """Random access to the records of a file; a context manager.

    Args:
        path: the file.

    Attributes:
        path: the file.
        size: of it [bytes].
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open('rb')
        self.size = os.fstat(self._file.fileno()).st_size

    def __enter__(self) -> 'McapFile':
        return self

    def __exit__(
        self, kind: type[BaseException] | None, e: BaseException | None, at: TracebackType | None
    ) -> None:
        self._file.close()

    def read(self, at: int, count: int) -> bytes:
        """Return bytes from an offset on; fewer at the end of the file."""
        return os.pread(self._file.fileno(), max(0, min(count, self.size - at)), at)

    def body(self, place: RecordPlace) -> bytes:
        """Return the body of a record."""
        return self.read(place.body, place.length)

    def record(self, at: int) -> RecordPlace | None:
        """Return the record at an offset, if there is one: complete, and of a valid length."""
        head = self.read(at, HEAD.size)
        if len(head) < HEAD.size:
            return None
        place = RecordPlace(at, *HEAD.unpack(head))
        longest = self.size if place.opcode >= _PRIVATE_OPCODES else 0
        if place.opcode in _KNOWN:
            longest = _MAX_LENGTHS.get(Opcode(place.opcode), MAX_DEFINITION)
        shortest = _MIN_LENGTHS.get(place.opcode, 0)
        return place if shortest <= place.length <= longest and place.end <= self.size else None

    def records(self, at: int, stop: int) -> Iterator[RecordPlace]:
        """Yield record after record, up to an offset or to the first invalid one."""
        while at < stop and (place := self.record(at)) is not None:
            yield place
            at = place.end

    def footer(self) -> Footer | None:
        """Return the end of the file, if it has one."""
        at = self.size - _END
        data = self.read(at, _END) if at > 0 else b''
        if not data.endswith(MAGIC) or data[: HEAD.size] != HEAD.pack(Opcode.FOOTER, FOOTER.size):
            return None
        summary_start, _, crc = FOOTER.unpack_from(data, HEAD.size)
        if summary_start and not len(MAGIC) < summary_start <= at:
            return None
        return Footer(RecordPlace(at, Opcode.FOOTER, FOOTER.size), summary_start, crc)

    def next_place(self, at: int) -> int:
        """Return the next offset at which a record seems to begin; the file's size where none does.

        A record seems to begin where a head fits and two more follow upon another, or the end.
        """
        while at < self.size:
            window = self.read(at, _WINDOW + HEAD.size)
            for match in _LIKE_A_HEAD.finditer(window):
                if match.start() < _WINDOW and self._continues(at + match.start()):
                    return at + match.start()
            at += _WINDOW
        return self.size

    def _continues(self, at: int) -> bool:
        for _ in range(3):
            place = self.record(at)
            if place is None:
                return False
            at = place.end
            if at == self.size or self.read(at, len(MAGIC)) == MAGIC:
                return True
        return True
