"""Integrity check of a bag: every checksum, every index and metadata.yaml against the file.

It is stricter than a reader has to be, so that every reader accepts a bag that passes.
"""

import json
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Header,
    Message,
    MessageIndex,
    MetadataIndex,
    Schema,
    SummaryOffset,
)

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.mcap.chunks import (
    ChunkError,
    McapRecord,
    UnpackBudget,
    read_chunk,
    read_record,
    records,
    unpack,
)
from cutting_trainer.bags.mcap.records import MAGIC, Footer, McapFile, RecordPlace
from cutting_trainer.bags.mcap.summary import McapSummary, read_index, read_summary, summary_places
from cutting_trainer.bags.metadata import Tally, Topic, bag_information, read_metadata
from cutting_trainer.bags.recorded_qos import profiles_from

_COMPARED = (
    *('storage_identifier', 'duration', 'starting_time', 'message_count'),
    *('relative_file_paths', 'compression_format', 'compression_mode'),
)
_MAX_ATTACHMENT_BYTES = 1 << 24
"""Bytes of an attachment up to which its checksum is verified."""


def flaw(folder: Path, path: Path) -> str:
    """Return the first fault of a bag, '' where it is intact.

    Args:
        folder: of the bag.
        path: its MCAP file.
    """
    try:
        with McapFile(path) as file:
            check = _Check(file)
            check.run()
        _compare(read_metadata(folder), path.name, check)
    except BagError as error:
        return str(error)
    return ''


class _Check:
    """Checks a file from its first byte to its last.

    Attributes:
        summary: of the file.
        tally: messages by topic, with the times of the first and the last.
    """

    def __init__(self, file: McapFile) -> None:
        self._file = file
        footer, summary = file.footer(), read_summary(file)
        if footer is None or summary is None:
            raise ChunkError('it has no end')
        if summary.flaw:
            raise ChunkError(summary.flaw)
        self._footer: Footer = footer
        self.summary: McapSummary = summary
        self.tally = Tally()
        self._room = UnpackBudget(file.path, file.size)
        self._indexes = self._in_summary(Opcode.CHUNK_INDEX)
        self._counts: Counter[int] = Counter()
        self._others: dict[int, list[tuple[int, int]]] = {}
        self._chunks = 0
        self._data_crc = 0

    def run(self) -> None:
        """Check the whole file.

        Raises:
            BagError: the first fault.
        """
        at = self._check_data()
        if at != self._footer.summary_start:
            raise ChunkError('its summary is not where its data ends')
        if next(self._indexes, None) is not None:
            raise ChunkError('its index has a chunk that is not there')
        self._check_statistics()
        self._check_places()

    def _in_summary(self, opcode: int) -> Iterator[RecordPlace]:
        return (p for p in summary_places(self._file, self._footer) if p.opcode == opcode)

    def _check_data(self) -> int:
        """Check the records before the summary; return where they end."""
        self._data_crc = zlib.crc32(MAGIC)
        at, place = len(MAGIC), None
        while at < self._file.size:
            place = self._file.record(at)
            if place is None:
                raise ChunkError(f'at byte {at} there is no record')
            if at == len(MAGIC):
                header = read_index(Header, self._head(place))
                if place.opcode != Opcode.HEADER or header.profile != 'ros2':
                    raise ChunkError('it does not begin as a bag of ROS 2')
            if place.opcode == Opcode.DATA_END:
                given = read_index(DataEnd, self._file.body(place)).data_section_crc
                if given not in (0, self._data_crc):
                    raise ChunkError('the checksum of its data does not hold')
                return place.end
            at = self._check_record(place)
        raise ChunkError('its data has no end')

    def _check_record(self, place: RecordPlace) -> int:
        """Check a record, a chunk with the indexes behind it; return where they end."""
        self._sum(place)
        if place.opcode == Opcode.CHUNK:
            return self._check_chunk(place)
        if place.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            record = read_record(place.opcode, self._file.body(place))
            if record is not None:
                self._check_known(record)
        elif place.opcode == Opcode.ATTACHMENT and place.length <= _MAX_ATTACHMENT_BYTES:
            body = self._file.body(place)
            read_index(Attachment, body)
            given = int.from_bytes(body[-4:], 'little')
            if given not in (0, zlib.crc32(body[:-4])):
                raise ChunkError('the checksum of an attachment does not hold')
        self._others.setdefault(place.opcode, []).append((place.offset, place.end - place.offset))
        return place.end

    def _head(self, place: RecordPlace) -> bytes:
        return self._file.read(place.body, min(place.length, 1 << 16))

    def _sum(self, place: RecordPlace) -> None:
        at = place.offset
        while at < place.end:
            data = self._file.read(at, min(1 << 20, place.end - at))
            if not data:
                raise ChunkError('it has become shorter')
            self._data_crc, at = zlib.crc32(data, self._data_crc), at + len(data)

    def _check_chunk(self, place: RecordPlace) -> int:
        chunk = read_chunk(self._file.body(place))
        unpacked = unpack(chunk)
        self._room.take(unpacked)
        where = f'the chunk at byte {place.offset}'
        if not unpacked.complete or len(unpacked.data) != chunk.uncompressed_size:
            raise ChunkError(f'{where} does not unpack to its stated size')
        if unpacked.wrong:
            raise ChunkError(f'the checksum of {where} does not hold')
        counted: dict[int, list[tuple[int, int]]] = {}
        times = []
        for at, record in records(unpacked.data):
            self._check_known(record)
            if isinstance(record, Message):
                counted.setdefault(record.channel_id, []).append((record.log_time, at))
                times.append(record.log_time)
        span = (min(times, default=0), max(times, default=0))
        if times and (chunk.message_start_time, chunk.message_end_time) != span:
            raise ChunkError(f'{where} does not have its stated times')
        end, offsets = self._check_message_indexes(place, counted)
        index_place = next(self._indexes, None)
        if index_place is None:
            raise ChunkError(f'{where} is not in the index')
        index = read_index(ChunkIndex, self._file.body(index_place))
        stated = (
            *(index.chunk_start_offset, index.chunk_length, index.message_index_offsets),
            *(index.message_index_length, index.compression, index.compressed_size),
            *(index.uncompressed_size, index.message_start_time, index.message_end_time),
        )
        found = (
            *(place.offset, place.end - place.offset, offsets, end - place.end),
            *(chunk.compression, len(chunk.data), chunk.uncompressed_size),
            *(chunk.message_start_time, chunk.message_end_time),
        )
        if stated != found:
            raise ChunkError(f'the index has another entry for {where}')
        self._chunks += 1
        return end

    def _check_message_indexes(
        self, chunk: RecordPlace, counted: dict[int, list[tuple[int, int]]]
    ) -> tuple[int, dict[int, int]]:
        """Return the end of the indexes behind a chunk, and the start of each, by channel."""
        end, offsets = chunk.end, dict[int, int]()
        for place in self._file.records(chunk.end, self._file.size):
            if place.opcode != Opcode.MESSAGE_INDEX:
                break
            self._sum(place)
            listed = read_index(MessageIndex, self._file.body(place))
            if sorted(listed.records) != sorted(counted.get(listed.channel_id, [])):
                raise ChunkError(f'an index behind the chunk at byte {chunk.offset} is wrong')
            if listed.records:
                offsets[listed.channel_id] = place.offset
            end = place.end
        if offsets and offsets.keys() != counted.keys():
            raise ChunkError(f'an index behind the chunk at byte {chunk.offset} is missing')
        return end, offsets

    def _check_known(self, record: McapRecord) -> None:
        if isinstance(record, Message):
            channel = self.summary.channels.get(record.channel_id)
            if channel is None:
                raise ChunkError('a message is of a channel that the summary does not have')
            self.tally.add(channel.topic, record.log_time)
            self._counts[record.channel_id] += 1
            return
        known = self.summary.schemas if isinstance(record, Schema) else self.summary.channels
        if known.get(record.id) != record:
            raise ChunkError('the summary does not have the definitions that the data has')

    def _check_statistics(self) -> None:
        stated = self.summary.statistics
        if stated is None:
            raise ChunkError('its summary has no statistics')
        counts = {channel: n for channel, n in stated.channel_message_counts.items() if n}
        others = self._others
        said = (
            *(stated.message_count, counts, stated.chunk_count, stated.schema_count),
            *(stated.channel_count, stated.attachment_count, stated.metadata_count),
            *(stated.message_start_time, stated.message_end_time),
        )
        found = (
            *(self.tally.messages, dict(self._counts), self._chunks, len(self.summary.schemas)),
            *(len(self.summary.channels), len(others.get(Opcode.ATTACHMENT, ()))),
            *(len(others.get(Opcode.METADATA, ())), self.tally.start, self.tally.end),
        )
        if said != found:
            raise ChunkError('its statistics do not match its content')

    def _check_places(self) -> None:
        """Check the places of attachments, metadata and groups of the summary."""
        for kind, opcode, of in (
            (AttachmentIndex, Opcode.ATTACHMENT_INDEX, Opcode.ATTACHMENT),
            (MetadataIndex, Opcode.METADATA_INDEX, Opcode.METADATA),
        ):
            indexes = [read_index(kind, self._file.body(p)) for p in self._in_summary(opcode)]
            if sorted((i.offset, i.length) for i in indexes) != self._others.get(of, []):
                raise ChunkError('its index has another place for an attachment or metadata')
        for place in self._in_summary(Opcode.SUMMARY_OFFSET):
            group = read_index(SummaryOffset, self._file.body(place))
            first = self._file.record(group.group_start)
            if group.group_length and (first is None or first.opcode != group.group_opcode):
                raise ChunkError('its summary has no such group at the stated place')


def _compare(information: dict[str, Any], name: str, check: _Check) -> None:
    """Compare metadata.yaml with the content of the file."""
    topics = _topics(check.summary)
    expected = bag_information(name, topics, check.tally, {})
    for key in _COMPARED:
        if information.get(key) != expected[key]:
            raise BagError(f'metadata.yaml has another value of {key}')
    listed = information.get('topics_with_message_count')
    if not isinstance(listed, list) or _by_name(listed) != _by_name(
        expected['topics_with_message_count']
    ):
        raise BagError('metadata.yaml does not have the topics of the file')
    if information.get('version') != expected['version']:
        raise BagError('metadata.yaml is of another version')


def _topics(summary: McapSummary) -> dict[str, Topic]:
    topics = {}
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        if schema is None or channel.topic in topics or not isinstance(channel, Channel):
            raise BagError(f'the topic {channel.topic[:80]} is there twice, or is not defined')
        topics[channel.topic] = Topic(
            channel.topic,
            schema.name,
            channel.metadata.get('topic_type_hash', ''),
            tuple(profiles_from(channel.metadata.get('offered_qos_profiles', ''))),
        )
    return topics


def _by_name(listed: Any) -> list[Any]:
    return sorted(listed, key=lambda each: json.dumps(each, sort_keys=True, default=str))
