"""Reading bags without ROS, those that a crash has cut off included."""

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk

from bags.cdr import Decoder
from bags.errors import BagError
from bags.metadata import FORMAT_VERSION, read_metadata
from bags.qos import OfferedQos, profiles_from

_MAGIC = b'\x89MCAP0\r\n'
_RECORD_HEAD = struct.Struct('<BQ')


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a bag.

    Attributes:
        topic: its topic.
        type: `package/msg/Type`.
        log_time: when it was received [ns since the epoch].
        publish_time: its source time stamp [ns since the epoch].
        sequence: its number in the sequence of its publisher, 0 where unknown.
        data: CDR with its encapsulation header.
    """

    topic: str
    type: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class Bag:
    """A bag on disk; made by `open_bag`.

    Attributes:
        path: the MCAP file.
        complete: whether the file has its end; without it the recorder was killed or the disk full,
            and the complete chunks are what is read.
        custom_data: as the recorder wrote it: scene, seed, versions.
        schemas: definition text by type.
        span: smallest and largest log time [ns since the epoch], zeros where there is no message.
    """

    def __init__(self, path: Path, custom_data: dict[str, str]) -> None:
        self.path = path
        self.custom_data = custom_data
        self._topics: dict[str, str] = {}
        self._profiles: dict[str, str] = {}
        self.schemas: dict[str, str] = {}
        self._decoder = Decoder(self.schemas)
        self.span = (0, 0)
        self.complete = self._read_summary()
        if not self.complete:
            times = [message.log_time for _, _, message in self._salvage()]
            self.span = (min(times), max(times)) if times else (0, 0)

    def topics(self) -> dict[str, str]:
        """Type by topic."""
        return dict(self._topics)

    def profiles(self, topic: str) -> list[OfferedQos]:
        """QoS that the publishers of a topic offered."""
        return profiles_from(self._profiles.get(topic, ''))

    def messages(
        self, topics: Collection[str] | None = None, *, since: int = 0
    ) -> Iterator[Recorded]:
        """Messages in the order of their log times (within a chunk only, where the end is missing).

        Args:
            topics: those to read; all by default.
            since: smallest log time [ns since the epoch].

        Raises:
            BagError: something in it is damaged.
        """
        source = self._indexed(topics, since) if self.complete else self._salvage()
        for schema, channel, message in source:
            if (topics is None or channel.topic in topics) and message.log_time >= since:
                yield Recorded(
                    channel.topic,
                    schema.name,
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                    message.data,
                )

    def read(self, recorded: Recorded) -> Any:
        """The message of what was recorded, by the bag's own definition of its type.

        Arrays of numbers are NumPy arrays, all other arrays lists.

        Raises:
            BagError: the bytes are not such a message.
        """
        return self._decoder.decode(recorded.type, recorded.data)

    def _know(self, schema: Schema, channel: Channel) -> None:
        self._topics[channel.topic] = schema.name
        self._profiles[channel.topic] = channel.metadata.get('offered_qos_profiles', '')
        self.schemas[schema.name] = schema.data.decode()

    def _read_summary(self) -> bool:
        with self.path.open('rb') as file:
            # Without its end the last bytes are anything: the library would take them for records.
            file.seek(-min(len(_MAGIC), self.path.stat().st_size), SEEK_END)
            closed = file.read() == _MAGIC
            file.seek(0)
            if not closed:
                return False
            try:
                summary = make_reader(file).get_summary()
            except (McapError, struct.error):
                return False
        if summary is None:
            return False
        for channel in summary.channels.values():
            self._know(summary.schemas[channel.schema_id], channel)
        if summary.statistics is not None:
            counted = summary.statistics
            self.span = (counted.message_start_time, counted.message_end_time)
        return True

    def _indexed(
        self, topics: Collection[str] | None, since: int
    ) -> Iterator[tuple[Schema, Channel, Message]]:
        with self.path.open('rb') as file:
            reader = make_reader(file, validate_crcs=True)
            try:
                for schema, channel, message in reader.iter_messages(topics, starting_at=since):
                    assert schema is not None
                    yield schema, channel, message
            except Exception as error:  # whatever the damage makes a parser say
                raise BagError(
                    f'{self.path} is damaged ({error}): `trainer repair` makes it readable again, '
                    'without what is damaged'
                ) from None

    def _salvage(self) -> Iterator[tuple[Schema, Channel, Message]]:
        for chunk in salvage(self.path):
            for channel in chunk.channels:
                self._know(chunk.schemas[channel.schema_id], channel)
            for channel, message in sorted(chunk.messages, key=lambda pair: pair[1].log_time):
                yield chunk.schemas[channel.schema_id], channel, message


def open_bag(folder: Path | str) -> Bag:
    """Opens a bag for reading.

    Args:
        folder: the bag's folder, the one with metadata.yaml.

    Raises:
        BagError: it is not a bag of one MCAP file, or of a format to come.
    """
    folder = Path(folder)
    information = read_metadata(folder)
    path = mcap_file(folder)
    data = dict(information.get('custom_data') or {})
    version = str(data.get('format_version', FORMAT_VERSION))
    if not version.isdigit() or int(version) > FORMAT_VERSION:
        raise BagError(
            f'{folder} has format {version}: this trainer reads formats up to {FORMAT_VERSION}, '
            'a newer one is needed'
        )
    return Bag(path, data)


def mcap_file(folder: Path) -> Path:
    """The one MCAP file of a bag, by its metadata.yaml or, where there is none, by its ending.

    Raises:
        BagError: it is not a bag of one MCAP file.
    """
    try:
        information = read_metadata(folder)
        names = information.get('relative_file_paths') or []
        storage = information.get('storage_identifier')
    except BagError:
        if folder.is_file() or not any(folder.glob('*.mcap')):
            raise
        names, storage = [path.name for path in folder.glob('*.mcap')], 'mcap'
    if storage != 'mcap' or len(names) != 1:
        raise BagError(f'{folder} is not a bag of one MCAP file: it names {names}')
    path = folder / Path(names[0]).name
    if not path.is_file():
        raise BagError(f'{folder} lacks its file {path.name}')
    with path.open('rb') as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BagError(f'{path} is not an MCAP file')
    return path


@dataclass
class Salvaged:
    """One complete chunk of a file.

    Attributes:
        end: where it ends in the file [bytes].
        damaged: its checksum does not hold: what was in it is gone.
        schemas: all known so far, by number.
        channels: that became known in this chunk.
        messages: with their channels, in the order of the file.
        strangers: messages of channels that were in a damaged chunk.
    """

    end: int
    damaged: bool = False
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: list[Channel] = field(default_factory=list)
    messages: list[tuple[Channel, Message]] = field(default_factory=list)
    strangers: int = 0


def salvage(path: Path) -> Iterator[Salvaged]:
    """Reads chunk by chunk without index or end, up to the first record that is not all there."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for end, body in _complete_chunks(path):
        chunk = Salvaged(end, schemas=schemas)
        try:
            records = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
        except Exception:  # whatever zstd, lz4 or the parser says of bytes that are not their own
            chunk.damaged = True
            records = []
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = record
                chunk.channels.append(record)
            elif isinstance(record, Message) and record.channel_id in channels:
                chunk.messages.append((channels[record.channel_id], record))
            else:
                chunk.strangers += isinstance(record, Message)
        yield chunk


def _complete_chunks(path: Path) -> Iterator[tuple[int, bytes]]:
    """Where each chunk of a file ends, and its bytes, up to a record that is not all there."""
    size = path.stat().st_size
    with path.open('rb') as file:
        file.seek(len(_MAGIC))
        while head := _record_head(file):
            opcode, length = head
            if file.tell() + length > size:
                return
            body = file.read(length)
            if opcode == Opcode.CHUNK:
                yield file.tell(), body


def _record_head(file: BinaryIO) -> tuple[int, int] | None:
    head = file.read(_RECORD_HEAD.size)
    return _RECORD_HEAD.unpack(head) if len(head) == _RECORD_HEAD.size else None
