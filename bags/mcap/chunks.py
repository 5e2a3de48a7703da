"""Bounded unpacking of the chunks of an MCAP file.

A chunk of 100 kB can unpack to gigabytes, and state any size. Its unpacked size is bounded, as
such and in relation to its size in the file, before and while it is unpacked.
"""

import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from cutting_trainer.bags.errors import BagError

MAX_CHUNK = 96 << 20
"""Bytes of a chunk, unpacked: the recorder's largest message (64 MB) with those beside it."""
MAX_RATIO = 256
"""Unpacked bytes per byte of a chunk, beyond the first `SMALL`."""
SMALL = 4 << 20
MAX_RECORDS = 1 << 18
"""Messages and definitions in a chunk; the recorder puts 0.2 s into one."""
MAX_DEFINITION = 1 << 20
"""Bytes of a schema or channel."""

MAX_FILE_RATIO = 100
"""Unpacked bytes per byte of a file, on average, beyond the first `SMALL_FILE`."""
SMALL_FILE = 1 << 26

_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, sequence, log time and publish time, before the data of a message."""
_PIECE = 1 << 16

McapRecord = Schema | Channel | Message


class ChunkError(BagError):
    """A chunk is invalid, or beyond a bound."""


class UnpackBudget:
    """Remaining number of bytes to which the chunks of a file may unpack in total.

    Args:
        path: of the file, for the error.
        size: of the file [bytes].
    """

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        self._max_bytes = SMALL_FILE + MAX_FILE_RATIO * size
        self._left = self._max_bytes

    def take(self, unpacked: 'Unpacked') -> None:
        """Count the bytes of an unpacked chunk.

        Raises:
            BagError: the total is too large; no damage to a bag gives that.
        """
        self._left -= len(unpacked.data)
        if self._left < 0:
            raise BagError(
                f'{self._path} unpacks to more than {self._max_bytes} bytes: no such bag does'
            )


@dataclass(frozen=True)
class Unpacked:
    """The unpacked bytes of a chunk.

    Attributes:
        data: as far as they could be unpacked.
        complete: whether they are all there.
        checked: whether the checksum is right; false too where there is none.
        wrong: the checksum is wrong.
    """

    data: bytes
    complete: bool
    checked: bool
    wrong: bool


def read_chunk(body: bytes) -> Chunk:
    """Return the chunk in the bytes of a record.

    Raises:
        ChunkError: the bytes are not a chunk.
    """
    try:
        return Chunk.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError) as error:
        raise ChunkError(f'a chunk has no head: {error}') from None


def unpack(chunk: Chunk) -> Unpacked:
    """Unpack a chunk as far as it goes.

    Raises:
        ChunkError: its compression is unknown, or it unpacks to more than allowed.
    """
    limit = min(MAX_CHUNK, max(SMALL, MAX_RATIO * len(chunk.data)))
    if chunk.uncompressed_size > limit:
        raise ChunkError(
            f'a chunk of {len(chunk.data)} bytes says that it unpacks to '
            f'{chunk.uncompressed_size}: {limit} at most'
        )
    if chunk.compression == 'zstd':
        data, complete = _unpack_zstd(chunk.data, limit, chunk.uncompressed_size)
    elif chunk.compression == 'lz4':
        data, complete = _unpack_lz4(chunk.data, limit)
    elif chunk.compression == '':
        data, complete = chunk.data, True
    else:
        raise ChunkError(f'a chunk is packed by {chunk.compression[:20]!r}: zstd and lz4 are known')
    if len(data) > limit:
        raise ChunkError(f'a chunk of {len(chunk.data)} bytes unpacks to more than {limit}')
    same = complete and zlib.crc32(data) == chunk.uncompressed_crc
    given = chunk.uncompressed_crc != 0
    return Unpacked(data, complete, given and same, given and not same)


def _unpack_zstd(data: bytes, limit: int, size: int) -> tuple[bytes, bool]:
    """Unpack a zstd frame, up to one byte beyond the limit; return whether it is complete."""
    out = bytearray()
    try:
        stated = zstandard.frame_content_size(data)
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as reader:
            while len(out) <= limit and (piece := reader.read(min(_PIECE, limit + 1 - len(out)))):
                out += piece
    except (zstandard.ZstdError, ValueError):
        return bytes(out), False
    return bytes(out), len(out) == (stated if stated >= 0 else size)


def _unpack_lz4(data: bytes, limit: int) -> tuple[bytes, bool]:
    """Unpack an lz4 frame, up to one byte beyond the limit; return whether it is complete."""
    out = bytearray()
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        while len(out) <= limit and not decompressor.eof:
            piece = decompressor.decompress(data, max_length=min(_PIECE, limit + 1 - len(out)))
            data = b''
            if not piece and decompressor.needs_input:
                return bytes(out), False
            out += piece
    except RuntimeError:
        return bytes(out), False
    return bytes(out), decompressor.eof


def records(
    data: bytes, channels: Collection[int] | None = None
) -> Iterator[tuple[int, McapRecord]]:
    """Yield the schemas, channels and messages of an unpacked chunk, with their places in it.

    Args:
        data: of the chunk.
        channels: numbers of those whose messages are yielded; None: all.

    Raises:
        ChunkError: a record is invalid, or there are too many.
    """
    at, count, size = 0, 0, len(data)
    while at < size:
        place, count = at, count + 1
        if count > MAX_RECORDS:
            raise ChunkError(f'a chunk has more than {MAX_RECORDS} records')
        if at + _HEAD.size > size:
            raise ChunkError('a chunk ends within a record')
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size + length
        if at > size:
            raise ChunkError('a chunk ends within a record')
        if (
            channels is not None
            and opcode == Opcode.MESSAGE
            and length >= MESSAGE_HEAD.size
            and MESSAGE_HEAD.unpack_from(data, place + _HEAD.size)[0] not in channels
        ):
            continue
        record = read_record(opcode, data[place + _HEAD.size : at])
        if record is not None:
            yield place, record


def read_record(opcode: int, body: bytes) -> McapRecord | None:
    """Return a schema, channel or message from the bytes of its record; None for any other.

    Raises:
        ChunkError: it is damaged, or a definition is longer than it may be.
    """
    if opcode == Opcode.MESSAGE:
        if len(body) < MESSAGE_HEAD.size:
            raise ChunkError(f'a message of {len(body)} bytes has no head')
        channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(body)
        return Message(channel, log_time, body[MESSAGE_HEAD.size :], publish_time, sequence)
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return None
    if len(body) > MAX_DEFINITION:
        raise ChunkError(f'a definition has {len(body)} bytes: {MAX_DEFINITION} at most')
    kind = Schema if opcode == Opcode.SCHEMA else Channel
    try:
        record: Schema | Channel = kind.read(ReadDataStream(BytesIO(body)))
        if isinstance(record, Schema):
            record.data.decode()
    except (McapError, struct.error, ValueError) as error:
        raise ChunkError(f'a definition is damaged: {error}') from None
    return record
