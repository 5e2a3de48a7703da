"""Recovery of the messages of one damaged chunk of an MCAP file."""

import re
import struct
import sys
from dataclasses import replace

from mcap.opcode import Opcode
from mcap.records import Chunk, Message

from cutting_trainer.bags.mcap.chunks import (
    MESSAGE_HEAD,
    ChunkError,
    McapRecord,
    Unpacked,
    read_chunk,
    read_record,
    records,
    unpack,
)
from cutting_trainer.bags.mcap.records import HEAD

CHUNK_HEAD = re.compile(
    rb'\x06[\x00-\xff]{5}\x00{3}[\x00-\xff]{28}(?:\x04\0\0\0zstd|\x03\0\0\0lz4)'
)
_PACKED = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}
"""First bytes of packed data, by the name of its compression."""
_NAMES = ('', *_PACKED.values())
_FIXED = struct.Struct('<QQQI')
_LENGTH = struct.Struct('<Q')


def inner_length(body: bytes) -> int | None:
    """Return the length of a chunk's record by its inner lengths, from its first bytes."""
    for name in (b'zstd', b'lz4', b''):
        prefix = len(name).to_bytes(4, 'little') + name
        at = 28 + len(prefix)
        if body[28:at] == prefix and len(body) >= at + _LENGTH.size:
            return at + _LENGTH.size + int(_LENGTH.unpack_from(body, at)[0])
    return None


def opened(body: bytes) -> tuple[Chunk | None, Unpacked | None]:
    """Return a chunk and its unpacked bytes, by the compression's magic where its head is wrong.

    Args:
        body: of its record, as far as it is there.

    Returns:
        The chunk by its head, or None; its unpacked bytes, or None.
    """
    try:
        chunk = read_chunk(body)
        if chunk.compression in _NAMES:
            return chunk, unpack(chunk)
    except ChunkError:
        pass
    if len(body) < _FIXED.size:
        return None, None
    start, stop, _, crc = _FIXED.unpack_from(body)
    for mark, name in _PACKED.items():
        at = body.find(mark, 0, 80)
        if at >= 0:
            chunk = Chunk(name, body[at:], stop, start, crc, 0)
            try:
                unpacked = unpack(chunk)
            except ChunkError:
                return chunk, None
            return chunk, replace(unpacked, wrong=not unpacked.checked)
    return None, None


def prefix(data: bytes) -> tuple[list[McapRecord], bool]:
    """Return the records of a chunk up to the first invalid one; whether they are all."""
    found: list[McapRecord] = []
    try:
        for _, record in records(data):
            found.append(record)
    except ChunkError:
        return found, False
    return found, True


def behind(
    unpacked: Unpacked, counted: list[tuple[int, int, int]], before: list[McapRecord]
) -> list[McapRecord]:
    """Return messages behind damage within a chunk: those in an index.

    A message that says it is longer than the chunk ends where the next one in the index begins.

    Args:
        unpacked: the chunk.
        counted: channel, log time and place of its messages, by the indexes behind it.
        before: messages found without the indexes.
    """
    known = {(m.channel_id, m.log_time, m.sequence) for m in before if isinstance(m, Message)}
    found: list[McapRecord] = []
    data = unpacked.data
    last = len(data) if unpacked.complete else sys.maxsize
    listed = sorted(counted, key=lambda entry: entry[2])
    places = [at for _, _, at in listed]
    for (channel, time, at), after in zip(listed, [*places[1:], last], strict=False):
        head = data[at : at + HEAD.size]
        if len(head) < HEAD.size or head[0] != Opcode.MESSAGE:
            continue
        begin = at + HEAD.size
        end = begin + HEAD.unpack(head)[1]
        end = end if end <= len(data) else after
        body = data[begin:end]
        if len(body) != end - begin or len(body) < MESSAGE_HEAD.size:
            continue
        message = read_record(Opcode.MESSAGE, body)
        assert isinstance(message, Message)
        own = (message.channel_id, message.log_time, message.sequence)
        if own[:2] == (channel, time) and own not in known:
            found.append(message)
    return found
