"""Reader of bags without ROS, also of those that a crash has cut off."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema

from cutting_trainer.bags.cdr import Decoder
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.mcap.chunks import ChunkError
from cutting_trainer.bags.mcap.ordered import in_order
from cutting_trainer.bags.mcap.records import MAGIC, McapFile
from cutting_trainer.bags.mcap.salvage import Salvage
from cutting_trainer.bags.mcap.summary import McapSummary, read_summary
from cutting_trainer.bags.metadata import FORMAT_VERSION, METADATA_FILE, read_metadata
from cutting_trainer.bags.recorded_qos import OfferedQos, profiles_from
from cutting_trainer.bags.untrusted_yaml import text_by_key


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a bag.

    Attributes:
        topic: its topic.
        type: `package/msg/Type`.
        log_time: receive time [ns since the epoch].
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
            and only the complete chunks are read.
        custom_data: scene, seed, versions, as the recorder wrote them.
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
        self._summary = McapSummary()
        self.complete = self._read_summary()
        if not self.complete:
            self._read_salvage()

    def topics(self) -> dict[str, str]:
        """Return the types by topic."""
        return dict(self._topics)

    def profiles(self, topic: str) -> list[OfferedQos]:
        """Return the QoS that the publishers of a topic offered."""
        return profiles_from(self._profiles.get(topic, ''))

    def messages(
        self, topics: Collection[str] | None = None, *, since: int = 0
    ) -> Iterator[Recorded]:
        """Yield messages by log time (only within a chunk where the file's end is missing).

        Args:
            topics: those to read; all by default.
            since: smallest log time [ns since the epoch].

        Raises:
            BagError: a part of the bag is damaged.
        """
        source = self._indexed(topics, since) if self.complete else self._salvaged()
        for channel, message in source:
            known = self._topics.get(channel.topic)
            if known is None or (topics is not None and channel.topic not in topics):
                continue
            if message.log_time >= since:
                yield Recorded(
                    channel.topic,
                    known,
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                    message.data,
                )

    def read(self, recorded: Recorded) -> Any:
        """Decode a recorded message, by the bag's own definition of its type.

        Arrays of numbers are NumPy arrays, all other arrays lists.

        Raises:
            BagError: the bytes do not fit the type.
        """
        return self._decoder.decode(recorded.type, recorded.data)

    def _know(self, channels: Mapping[int, Channel], schemas: Mapping[int, Schema]) -> None:
        for channel in channels.values():
            schema = schemas.get(channel.schema_id)
            if schema is not None:
                self._topics[channel.topic] = schema.name
                self._profiles[channel.topic] = channel.metadata.get('offered_qos_profiles', '')
                self.schemas[schema.name] = schema.data.decode()

    def _read_summary(self) -> bool:
        with McapFile(self.path) as file:
            summary = read_summary(file)
        if summary is None or summary.flaw or not (summary.chunks or summary.messages == 0):
            return False
        self._summary = summary
        self._know(summary.channels, summary.schemas)
        if summary.statistics is not None:
            counted = summary.statistics
            self.span = (counted.message_start_time, counted.message_end_time)
        return True

    def _read_salvage(self) -> None:
        with Salvage(self.path) as salvage:
            self._know(salvage.channels, salvage.schemas)
            first, last = math.inf, 0
            for chunk in salvage.chunks():
                for _, message in chunk.messages:
                    first, last = min(first, message.log_time), max(last, message.log_time)
        self.span = (int(first), last) if first != math.inf else (0, 0)

    def _indexed(
        self, topics: Collection[str] | None, since: int
    ) -> Iterator[tuple[Channel, Message]]:
        channels = self._summary.channels
        wanted = None if topics is None else {c.id for c in channels.values() if c.topic in topics}
        try:
            with McapFile(self.path) as file:
                yield from in_order(file, self._summary, wanted, since)
        except ChunkError as error:
            raise BagError(
                f'{self.path} is damaged ({error}): `trainer repair` makes it readable again, '
                'without the damaged parts'
            ) from None

    def _salvaged(self) -> Iterator[tuple[Channel, Message]]:
        with Salvage(self.path) as salvage:
            for chunk in salvage.chunks():
                yield from sorted(chunk.messages, key=lambda pair: pair[1].log_time)


class SplitBag(Bag):
    """A bag of several files, as `ros2 bag` splits it; read as one.

    Args:
        paths: of the files.
        custom_data: of the bag.

    Raises:
        BagError: one name has different meanings in the files.
    """

    def __init__(self, paths: Sequence[Path], custom_data: dict[str, str]) -> None:
        self.path = paths[0].parent
        self.custom_data = custom_data
        self._parts = [Bag(path, custom_data) for path in paths]
        self._topics: dict[str, str] = {}
        self._profiles: dict[str, str] = {}
        self.schemas: dict[str, str] = {}
        for part in self._parts:
            for mine, theirs in ((self._topics, part.topics()), (self.schemas, part.schemas)):
                for name, text in theirs.items():
                    if mine.setdefault(name, text) != text:
                        raise BagError(f'{part.path} has another {name} than the files before it')
            self._profiles |= part._profiles
        self._decoder = Decoder(self.schemas)
        spans = [part.span for part in self._parts if part.span[0]]
        self.span = (min(s for s, _ in spans), max(e for _, e in spans)) if spans else (0, 0)
        self.complete = all(part.complete for part in self._parts)

    def messages(
        self, topics: Collection[str] | None = None, *, since: int = 0
    ) -> Iterator[Recorded]:
        """Yield messages as `Bag.messages`, of all files."""
        parts = [part for part in self._parts if part.span[1] >= since]
        sources = (part.messages(topics, since=since) for part in parts)
        return merge(*sources, key=lambda recorded: recorded.log_time)


def open_bag(folder: Path | str) -> Bag:
    """Open a bag for reading.

    Args:
        folder: the bag's folder, the one with metadata.yaml.

    Raises:
        BagError: it is not a bag of MCAP files, or of a newer format.
    """
    folder = Path(folder)
    information = read_metadata(folder)
    paths = mcap_files(folder)
    data = text_by_key(information.get('custom_data'), f'custom_data of {folder / METADATA_FILE}')
    version = data.get('format_version', str(FORMAT_VERSION))[:20]
    if not version.isdecimal() or int(version) > FORMAT_VERSION:
        raise BagError(
            f'{folder} has format {version}: this trainer reads formats up to {FORMAT_VERSION}, '
            'a newer one is needed'
        )
    return Bag(paths[0], data) if len(paths) == 1 else SplitBag(paths, data)


def mcap_file(folder: Path) -> Path:
    """Return the one MCAP file of a bag.

    Raises:
        BagError: it is not a bag of one MCAP file.
    """
    paths = mcap_files(folder)
    if len(paths) > 1:
        names = [path.name for path in paths]
        raise BagError(f'{folder} is not a bag of one MCAP file: it names {names}')
    return paths[0]


def mcap_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a bag, by metadata.yaml or, without one, by their suffix.

    Raises:
        BagError: it is not a bag of MCAP files.
    """
    try:
        information = read_metadata(folder)
        names = information.get('relative_file_paths') or []
        storage = information.get('storage_identifier')
    except BagError:
        if folder.is_file() or not any(folder.glob('*.mcap')):
            raise
        names, storage = sorted(path.name for path in folder.glob('*.mcap')), 'mcap'
    if storage != 'mcap' or not names:
        raise BagError(f'{folder} is not a bag of MCAP files: it names {names}')
    paths = [folder / Path(name).name for name in names]
    for path in paths:
        if not path.is_file():
            raise BagError(f'{folder} lacks its file {path.name}')
        with path.open('rb') as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise BagError(f'{path} is not an MCAP file')
    return paths
