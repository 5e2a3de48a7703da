"""Bags that are made to harm their readers: valid ones with one replaced part."""

import random
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    Schema,
    Statistics,
)

from bench.files.hostile_files import BILLION
from cutting_trainer.bags.mcap.records import MAGIC
from cutting_trainer.bags.metadata import (
    METADATA_FILE,
    Tally,
    Topic,
    bag_information,
    write_metadata,
)

MESH = '/tissue/mesh'
TYPE = 'cutting_trainer_msgs/msg/Mesh'
TIME_NS = 1_790_000_000_000_000_000
"""Time of their messages [ns since the epoch]."""
Parts = dict[str, Any]


def packed(*records: Any) -> bytes:
    """Return the bytes of some records."""
    builder = RecordBuilder()
    for record in records:
        builder.write(record) if isinstance(record, bytes) else record.write(builder)
    return builder.end()


def message(data: bytes, log_time: int = TIME_NS, channel: int = 1) -> bytes:
    return packed(Message(channel, log_time, b'\x00\x01\x00\x00' + data, log_time, 0))


def chunk(data: bytes, compression: str = 'zstd', **lies: Any) -> Chunk:
    pack = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress, '': bytes}[compression]
    sizes = {'uncompressed_size': len(data), 'uncompressed_crc': zlib.crc32(data)}
    span = {'message_start_time': TIME_NS, 'message_end_time': TIME_NS + 10**9}
    return Chunk(**({'compression': compression, 'data': pack(data)} | span | sizes | lies))


def bomb(size: int, compression: str, **lies: Any) -> Chunk:
    """Return a chunk of zeros, which compresses well."""
    piece = bytes(1 << 20)
    if compression == 'zstd':
        packer = zstandard.ZstdCompressor(level=3).compressobj(size=size)
        data = b''.join(packer.compress(piece) for _ in range(size >> 20)) + packer.flush()
    else:
        data = (lines := lz4.frame.LZ4FrameCompressor()).begin(size)
        data += b''.join(lines.compress(piece) for _ in range(size >> 20)) + lines.flush()
    sizes = {'uncompressed_size': size, 'uncompressed_crc': 0}
    return Chunk(
        **(
            {'compression': compression, 'data': data, 'message_start_time': TIME_NS}
            | {'message_end_time': TIME_NS + 10**9} | sizes | lies
        )
    )  # fmt: skip


def write_bag(
    folder: Path,
    *chunks: Chunk | bytes,
    definition: str | bytes = 'int8 x',
    topic: str = MESH,
    kind: str = TYPE,
    profiles: str = '[]',
    custom_data: dict[str, Any] | None = None,
    times: tuple[int, int] = (TIME_NS, TIME_NS + 10**9),
    end: bool = True,
) -> None:
    """Write a bag of one topic with the summary and metadata that its chunks would have."""
    text = definition.encode() if isinstance(definition, str) else definition
    schema = Schema(1, text, 'ros2msg', kind)
    channel = Channel(1, topic, 'cdr', {'offered_qos_profiles': profiles}, 1)
    data, indexes = MAGIC + packed(Header('ros2', 'nobody'), schema, channel), []
    for each in chunks:
        body = packed(each)
        if isinstance(each, Chunk):
            span = (each.message_end_time, 0, {}, each.message_start_time)
            sizes = (len(data), each.compression, len(each.data))
            indexes.append(
                ChunkIndex(len(body), sizes[0], sizes[1], sizes[2], *span, each.uncompressed_size)
            )
        data += body
    data += packed(DataEnd(0))
    start = len(data)
    counts = {1: len(chunks)}
    statistics = Statistics(0, 1, counts, len(indexes), len(chunks), times[1], times[0], 0, 1)
    data += packed(schema, channel, *indexes, statistics)
    data += packed(Footer(start, 0, 0)) + MAGIC if end else b''
    folder.mkdir(parents=True)
    (folder / f'{folder.name}_0.mcap').write_bytes(data)
    tally = Tally({topic: len(chunks)}, *times)
    topics = {topic: Topic(topic, kind, '', ())}
    write_metadata(
        folder, bag_information(f'{folder.name}_0.mcap', topics, tally, custom_data or {})
    )


def mesh(definition: str | bytes, data: bytes = b'') -> Callable[[Path], None]:
    return lambda folder: write_bag(folder, chunk(message(data)), definition=definition)


def scene(**custom_data: Any) -> Callable[[Path], None]:
    """Return a valid sample with another description."""

    def make(folder: Path) -> None:
        sample = Path(__file__).parents[2] / 'bags' / 'samples' / 'format_7' / 'palpation'
        shutil.copytree(sample, folder)
        path = folder / METADATA_FILE
        content = yaml.safe_load(path.read_text())
        data = content['rosbag2_bagfile_information']['custom_data'] | custom_data
        content['rosbag2_bagfile_information']['custom_data'] = data
        path.write_text(yaml.safe_dump(content))

    return make


def information(**changes: Any) -> Callable[[Path], None]:
    """Return a valid sample with other metadata."""

    def make(folder: Path) -> None:
        scene()(folder)
        path = folder / METADATA_FILE
        content = yaml.safe_load(path.read_text())
        content['rosbag2_bagfile_information'] |= changes
        path.write_text(yaml.safe_dump(content))

    return make


def bytes_of_nothing(folder: Path) -> None:
    data = random.Random(1).randbytes(1 << 20)
    write_bag(folder, data, end=False)


def many(count: int, each: Callable[[int], Chunk]) -> Callable[[Path], None]:
    return lambda folder: write_bag(folder, *(each(i) for i in range(count)))


EMPTIES = 'p/E[] x\n' + '=' * 80 + '\nMSG: p/E\n'
FULL = message(bytes(100))
TINY = packed(Message(1, TIME_NS, b'', TIME_NS, 0))
HOSTILE_BAGS: dict[str, Callable[[Path], None]] = {
    'zstd: 100 kB to 3 GB': lambda f: write_bag(f, bomb(3 << 30, 'zstd')),
    'zstd: 100 kB to 3 GB, says 1 kB': lambda f: write_bag(
        f, bomb(3 << 30, 'zstd', uncompressed_size=1000)
    ),
    'lz4: to 1 GB': lambda f: write_bag(f, bomb(1 << 30, 'lz4')),
    'lz4: to 1 GB, says 1 kB': lambda f: write_bag(f, bomb(1 << 30, 'lz4', uncompressed_size=9)),
    'zstd: the same without an end': lambda f: write_bag(f, bomb(3 << 30, 'zstd'), end=False),
    'a chunk that says it is 2^60': lambda f: write_bag(f, chunk(FULL, uncompressed_size=1 << 60)),
    'a packing that is not known': lambda f: write_bag(
        f, packed(chunk(FULL)).replace(b'zstd', b'rar5')
    ),
    'two million messages in a chunk': lambda f: write_bag(f, chunk(TINY * 2_000_000)),
    '150 chunks of 4 MB of one time': many(150, lambda i: chunk(FULL * 30_000)),
    'a message within a message': lambda f: write_bag(f, chunk(FULL[:-5])),
    'a record of 2^60 bytes': lambda f: write_bag(
        f, struct.pack('<BQ', Opcode.MESSAGE, 1 << 60), chunk(FULL)
    ),
    'an attachment of 2^60 bytes': lambda f: write_bag(
        f, struct.pack('<BQ', Opcode.ATTACHMENT, 1 << 60), chunk(FULL)
    ),
    'an attachment that says 2^60': lambda f: write_bag(
        f, packed(Attachment(1, 1, 'a', 'b', b'')).replace(bytes(12), b'\xff' * 12), chunk(FULL)
    ),
    'metadata without end': lambda f: write_bag(
        f, struct.pack('<BQ', Opcode.METADATA, 12) + b'\x00' * 4 + b'\xff' * 8, chunk(FULL)
    ),
    'a megabyte of noise': bytes_of_nothing,
    'a megabyte of heads': lambda f: write_bag(f, (b'\x05' + b'\0' * 8) * 120_000, end=False),
    'times beyond all time': lambda f: write_bag(
        f, chunk(message(bytes(100), 2**64 - 1), message_end_time=2**64 - 1),
        times=(0, 2**63 - 1),
    ),
    'a type that contains itself': mesh(f'p/A x\n{"=" * 80}\nMSG: p/A\np/A x'),
    'a definition of 2 MB': mesh('int8 x\n' * 300_000),
    'a definition that is no text': mesh(b'\xff\xfe\x00 int8 x'),
    'a definition without fields': mesh(''),
    'a mesh with other fields': mesh('int32 step\nstring nodes', bytes(100)),
    'a mesh of words': mesh('string step\nstring revision\nstring rest\nstring tetrahedra',
                            struct.pack('<I', 4) * 40),
    'four billion empty structures': mesh(EMPTIES, b'\xff' * 4),
    'two million empty structures': mesh(EMPTIES, struct.pack('<I', 1 << 21) + bytes(1 << 21)),
    'a message cut short': mesh('float64[] rest\nuint64 step', b'\xff\xff\x00\x00'),
    'a type of an unknown package': lambda f: write_bag(f, chunk(FULL), kind='os/msg/System'),
    'a type that is no name': lambda f: write_bag(f, chunk(FULL), kind='a\n\x1b[2J' * 1000),
    'a topic of 100 kB': lambda f: write_bag(f, chunk(FULL), topic='/' + 't' * 100_000),
    'QoS by aliases': lambda f: write_bag(f, chunk(FULL), profiles=BILLION),
    'QoS that is none': lambda f: write_bag(f, chunk(FULL), profiles='[{depth: [1]}, 3]'),
    'a scene by aliases': scene(scene=BILLION),
    'a scene that is a list': scene(scene='[1, 2]'),
    'a scene 900 deep': scene(scene='[' * 900 + ']' * 900),
    'a scene of Python': scene(scene='tissue: !!python/object/apply:os.system ["true"]'),
    'a scene without a tissue': scene(scene='tool: {}'),
    'a format without end': scene(format_version='9' * 5000),
    'a format in other digits': scene(format_version='\u0663'),
    'words about it that are a list': information(custom_data=[1, 2]),
    'words about it that are nested': information(custom_data={'scene': {'tissue': 1}}),
    'a file elsewhere': information(relative_file_paths=['../../../../etc/passwd']),
    'files that are numbers': information(relative_file_paths=[7]),
    'files that are no list': information(relative_file_paths={'a': 'b'}),
    'a storage of another kind': information(storage_identifier=['mcap']),
}  # fmt: skip
"""Functions that make a bag in a new folder, by its defect."""
