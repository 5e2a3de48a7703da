"""Writer of bags in the format of `ros2 bag` on Jazzy: one MCAP file and metadata.yaml."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

from mcap.records import Attachment
from mcap.writer import Writer

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.metadata import Tally, Topic, bag_information, to_yaml, write_metadata
from cutting_trainer.bags.recorded_qos import Profiles, channel_profiles


class BagWriter:
    """Writes serialised messages to a new bag.

    Messages are gathered in a chunk that `flush` hands to the operating system: a process that is
    killed loses the messages after its last flush. When the disk is full, the file is cut back to
    the chunks that are complete, and all later messages are counted as lost: only the constructor
    and `add_topic` raise.

    Args:
        folder: the bag; must not exist, its parents are created.
        custom_data: for metadata.yaml, unchanged.

    Attributes:
        folder: the bag.
        topics: by name.
        tally: counts of the messages on disk.
        lost: number of messages by topic that the disk did not take.
        failure: the disk's error, empty while there is none.

    Raises:
        BagError: the folder exists or cannot be created.
    """

    def __init__(self, folder: Path, *, custom_data: Mapping[str, str] | None = None) -> None:
        self.folder = Path(folder)
        self.topics: dict[str, Topic] = {}
        self.tally = Tally()
        self.lost: dict[str, int] = {}
        self.failure = ''
        self._custom_data = dict(custom_data or {})
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._pending = Tally()
        self._closed = False
        try:
            self.folder.mkdir(parents=True)
            self._file = _StagedFile(self.folder / f'{self.folder.name}_0.mcap')
        except FileExistsError:
            raise BagError(f'{folder} exists already: name a new folder for the bag') from None
        except OSError as error:
            raise BagError(f'cannot create the bag {folder}: {error.strerror}') from None
        self._writer = Writer(self._file, enable_data_crcs=True)
        self._writer.start(profile='ros2')
        self._commit()
        self._write_metadata()

    @property
    def size(self) -> int:
        """Return the bytes of the MCAP file that are on disk."""
        return self._file.committed

    def add_topic(
        self, name: str, type_name: str, schema: str, type_hash: str, profiles: Profiles
    ) -> None:
        """Add a topic; to be done once, before its first message.

        Args:
            name: topic, with its leading slash.
            type_name: `package/msg/Type`.
            schema: `ros2msg` text of the type and of all contained types.
            type_hash: `RIHS01_...` of the type.
            profiles: QoS of its publishers.
        """
        if name in self.topics:
            raise BagError(f'{name} is in the bag already: one channel a topic')
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', schema.encode()
            )
        self.topics[name] = Topic(name, type_name, type_hash, tuple(profiles))
        self._channels[name] = self._writer.register_channel(
            name,
            'cdr',
            self._schemas[type_name],
            {'offered_qos_profiles': channel_profiles(profiles), 'topic_type_hash': type_hash},
        )

    def describe(self, **custom_data: str) -> None:
        """Add entries to metadata.yaml, at once; nothing happens where they are known already."""
        if not self._closed and not custom_data.items() <= self._custom_data.items():
            self._custom_data |= custom_data
            self._write_metadata()

    def write(
        self, topic: str, log_time: int, publish_time: int, data: bytes, sequence: int = 0
    ) -> None:
        """Add a message to the chunk in progress.

        Args:
            topic: a name given to `add_topic`.
            log_time: receive time [ns since the epoch].
            publish_time: its source time stamp [ns since the epoch].
            data: CDR with its encapsulation header.
            sequence: its number in the sequence of its publisher.
        """
        if self.failure or self._closed:
            self.lost[topic] = self.lost.get(topic, 0) + 1
            return
        self._pending.add(topic, log_time)
        self._writer.add_message(
            self._channels[topic], log_time, data, publish_time, sequence & 0xFFFFFFFF
        )

    def attach(self, attachment: Attachment) -> None:
        """Add an attachment of another bag."""
        if not (self.failure or self._closed):
            self._writer.add_attachment(
                attachment.create_time,
                attachment.log_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )

    def flush(self) -> None:
        """Complete the chunk in progress and hand it to the operating system."""
        if not (self.failure or self._closed):
            self._writer.flush()
            self._commit()

    def close(self) -> None:
        """Write pending messages, the summary and the final metadata.yaml; may be called again."""
        if self._closed:
            return
        self.flush()
        self._closed = True
        if not self.failure:
            self._writer.add_metadata(
                'rosbag2', {'serialized_metadata': to_yaml(self._information())}
            )
            self._writer.finish()
            self._commit()
        self._write_metadata()
        self._file.close()

    def _information(self) -> dict[str, object]:
        return bag_information(self._file.path.name, self.topics, self.tally, self._custom_data)

    def _commit(self) -> None:
        try:
            self._file.commit()
        except OSError as error:
            self.failure = f'cannot write {self._file.path}: {error.strerror}'
            for topic, count in self._pending.counts.items():
                self.lost[topic] = self.lost.get(topic, 0) + count
        else:
            self.tally.merge(self._pending)
        self._pending = Tally()

    def _write_metadata(self) -> None:
        try:
            write_metadata(self.folder, self._information())
        except OSError as error:
            self.failure = self.failure or f'cannot write metadata.yaml: {error.strerror}'


class _StagedFile(BytesIO):
    """Output file of the MCAP library: staged until `commit`, which is all or nothing."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.committed = 0
        self._file = path.open('xb', buffering=0)

    def tell(self) -> int:
        return self.committed + super().tell()

    def commit(self) -> None:
        """Write the staged bytes; on failure the file is cut back.

        Raises:
            OSError: the operating system did not take all of them.
        """
        staged = memoryview(self.getvalue())
        self.seek(0)
        self.truncate()
        written = 0
        try:
            while written < len(staged):
                written += self._file.write(staged[written:])
        except OSError:
            self._file.truncate(self.committed)
            raise
        self.committed += written

    def close(self) -> None:
        self._file.close()
        super().close()
