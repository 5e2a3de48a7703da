"""Reader of the summary of an MCAP file: definitions, chunk index, statistics."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics

from cutting_trainer.bags.mcap.chunks import ChunkError, read_record
from cutting_trainer.bags.mcap.records import Footer, McapFile, RecordPlace

MAX_DEFINITIONS = 1 << 26
"""Bytes of all schemas and channels of a file."""
MAX_CHUNKS = 1 << 20
"""Chunks of a file; a day of recording has 432,000."""
_CRC_SIZE = 4


class ChunkPlace(NamedTuple):
    """Index entry of a chunk.

    Attributes:
        start, end: smallest and largest log time [ns since the epoch].
        offset, length: of its record in the file [bytes].
        channels: numbers of those that have messages in it; empty where unknown.
    """

    start: int
    end: int
    offset: int
    length: int
    channels: frozenset[int]


@dataclass
class McapSummary:
    """The summary at the end of a file.

    Attributes:
        checked: its checksum is given and right.
        flaw: why it is not reliable, '' where it is.
        schemas, channels: by number.
        chunks: in the order of the file's index.
        statistics: counts, where it has them.
    """

    checked: bool = False
    flaw: str = ''
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkPlace] = field(default_factory=list)
    statistics: Statistics | None = None

    @property
    def messages(self) -> int | None:
        """Return the number of messages by the statistics; None where unknown or not reliable."""
        return self.statistics.message_count if self.statistics and not self.flaw else None


def read_summary(file: McapFile) -> McapSummary | None:
    """Return the readable part of the summary; None where the file has no end or no summary."""
    footer = file.footer()
    if footer is None or not footer.summary_start:
        return None
    summary = McapSummary()
    if footer.summary_crc:
        summary.checked = crc_of_summary(file, footer) == footer.summary_crc
        if not summary.checked:
            summary.flaw = 'the checksum of its summary does not hold'
    try:
        _fill(summary, file, footer)
    except ChunkError as error:
        summary.flaw = summary.flaw or str(error)
    return summary


def crc_of_summary(file: McapFile, footer: Footer) -> int:
    """Return the checksum over a summary and the footer up to the checksum itself."""
    stop, crc, at = footer.place.end - _CRC_SIZE, 0, footer.summary_start
    while at < stop:
        data = file.read(at, min(1 << 20, stop - at))
        crc, at = zlib.crc32(data, crc), at + len(data)
    return crc


def read_index(kind: Any, body: bytes) -> Any:
    """Parse a record of the summary or an index, by the class of the library.

    Raises:
        ChunkError: it is damaged.
    """
    stream = ReadDataStream(BytesIO(body))
    try:
        return kind.read(stream)
    except (McapError, struct.error, ValueError) as error:
        raise ChunkError(f'a record {kind.__name__} is damaged: {error}') from None


def summary_places(file: McapFile, footer: Footer) -> Iterator[RecordPlace]:
    """Yield the records of a summary.

    Raises:
        ChunkError: they do not lead to the footer.
    """
    at = footer.summary_start
    for place in file.records(at, footer.place.offset):
        yield place
        at = place.end
    if at != footer.place.offset:
        raise ChunkError('its summary is damaged')


def _fill(summary: McapSummary, file: McapFile, footer: Footer) -> None:
    sets: dict[frozenset[int], frozenset[int]] = {}
    defined = 0
    for place in summary_places(file, footer):
        if place.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            defined += place.length
            if defined > MAX_DEFINITIONS:
                raise ChunkError(f'its definitions have more than {MAX_DEFINITIONS} bytes')
            record = read_record(place.opcode, file.body(place))
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
        elif place.opcode == Opcode.CHUNK_INDEX:
            if len(summary.chunks) >= MAX_CHUNKS:
                raise ChunkError(f'it has more than {MAX_CHUNKS} chunks')
            index = read_index(ChunkIndex, file.body(place))
            channels = frozenset(index.message_index_offsets)
            summary.chunks.append(
                ChunkPlace(
                    *(index.message_start_time, index.message_end_time),
                    *(index.chunk_start_offset, index.chunk_length),
                    sets.setdefault(channels, channels),
                )
            )
        elif place.opcode == Opcode.STATISTICS:
            summary.statistics = read_index(Statistics, file.body(place))
