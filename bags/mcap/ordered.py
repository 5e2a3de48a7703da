"""Messages of a whole file by log time, chunk by chunk through its index."""

import heapq
from collections import deque
from collections.abc import Collection, Iterator

from mcap.opcode import Opcode
from mcap.records import Channel, Message

from cutting_trainer.bags.mcap.chunks import (
    ChunkError,
    McapRecord,
    UnpackBudget,
    read_chunk,
    records,
    unpack,
)
from cutting_trainer.bags.mcap.records import McapFile
from cutting_trainer.bags.mcap.summary import ChunkPlace, McapSummary

MAX_OPEN_BYTES = 1 << 28
MAX_OPEN_MESSAGES = 1 << 19
"""Bounds of the chunks that are unpacked at one time, because they overlap in time."""


def in_order(
    file: McapFile, summary: McapSummary, channels: Collection[int] | None, since: int
) -> Iterator[tuple[Channel, Message]]:
    """Yield messages with their channels.

    Args:
        file: with a summary.
        summary: of it.
        channels: numbers of those to read; None: all.
        since: smallest log time [ns since the epoch].

    Raises:
        BagError: index or chunk are damaged, or too many chunks overlap.
    """
    waiting = deque(sorted(c for c in summary.chunks if _concerns(c, channels, since)))
    unpacked: list[_OpenChunk] = []
    room = UnpackBudget(file.path, file.size)
    while waiting or unpacked:
        while waiting and (not unpacked or waiting[0].start <= unpacked[0].messages[0].log_time):
            chunk = _OpenChunk(chunk_at(file, waiting.popleft(), room, channels), since)
            if chunk.messages:
                heapq.heappush(unpacked, chunk)
            _check_room(unpacked)
        if unpacked:
            chunk = unpacked[0]
            message = chunk.messages.popleft()
            channel = summary.channels.get(message.channel_id)
            if channel is None:
                raise ChunkError(f'a message is of channel {message.channel_id}, which is none')
            yield channel, message
            if chunk.messages:
                heapq.heapreplace(unpacked, chunk)
            else:
                heapq.heappop(unpacked)


def _concerns(chunk: ChunkPlace, channels: Collection[int] | None, since: int) -> bool:
    wanted = channels is None or not chunk.channels or not chunk.channels.isdisjoint(channels)
    return wanted and chunk.end >= since


def _check_room(unpacked: 'list[_OpenChunk]') -> None:
    size = sum(chunk.size for chunk in unpacked)
    count = sum(len(chunk.messages) for chunk in unpacked)
    if size > MAX_OPEN_BYTES or count > MAX_OPEN_MESSAGES:
        raise ChunkError(f'{len(unpacked)} chunks of {size} bytes are of the same time')


class _OpenChunk:
    """An unpacked chunk; it sorts by the log time of its next message.

    Attributes:
        messages: remaining ones, by log time.
        size: of it [bytes].
    """

    def __init__(self, chunk: tuple[int, list[McapRecord]], since: int) -> None:
        self._offset, found = chunk
        kept = [m for m in found if isinstance(m, Message) and m.log_time >= since]
        kept.sort(key=lambda m: m.log_time)
        self.messages = deque(kept)
        self.size = sum(len(m.data) for m in kept)

    def __lt__(self, other: '_OpenChunk') -> bool:
        own, others = self.messages[0].log_time, other.messages[0].log_time
        return own < others or (own == others and self._offset < other._offset)


def chunk_at(
    file: McapFile, index: ChunkPlace, room: UnpackBudget, channels: Collection[int] | None
) -> tuple[int, list[McapRecord]]:
    """Return the offset of a chunk in its file, and its records.

    Args:
        file: with the chunk.
        index: of it.
        room: counter of unpacked bytes.
        channels: numbers of those whose messages are returned; None: all.

    Raises:
        BagError: there is none, it is damaged, or too large.
    """
    offset = index.offset
    place = file.record(offset)
    if place is None or place.opcode != Opcode.CHUNK or place.end - offset != index.length:
        raise ChunkError(f'its index has a chunk at byte {offset}, where none is')
    unpacked = unpack(read_chunk(file.body(place)))
    room.take(unpacked)
    if not unpacked.complete:
        raise ChunkError(f'the chunk at byte {offset} cannot be unpacked')
    if unpacked.wrong:
        raise ChunkError(f'the checksum of the chunk at byte {offset} does not hold')
    return offset, [record for _, record in records(unpacked.data, channels)]
