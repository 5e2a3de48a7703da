"""Damage of many kinds in bags: comparison of public readers with `repair`.

`./trainer run python -m bench.files.damaged_bags BAG [COUNT]` does it to copies of a bag,
and prints the failures.
"""

import random
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.stream_reader import StreamReader

from cutting_trainer.bags.mcap.records import MAGIC, McapFile
from cutting_trainer.bags.reader import Bag, mcap_file, open_bag
from cutting_trainer.bags.repair import repair_bag
from cutting_trainer.bags.writer import BagWriter

KINDS = ('bit', 'bytes', 'cut off', 'cut out', 'repeated', 'record twice', 'record lost', 'clock')
CLOCK_STEPS_NS = (-1_000_000_000, -50_000_000, 1_000_000_000, 3_600_000_000_000)
"""Steps of the clock [ns]."""
_NEXT_MESSAGE = bytes([Opcode.MESSAGE])
"""First byte of the record of a message."""
Messages = Counter[tuple[int, bytes]]
"""Log time and data, with how often they are there."""


def small_bag(
    source: Path, folder: Path, topics: Collection[str], messages: int, in_chunk: int
) -> Path:
    """Write the first messages of some topics of a bag into a new one of small chunks."""
    bag = open_bag(source)
    return _copy(bag, folder, topics, messages, in_chunk, lambda at, time: time)


def damage(folder: Path, kind: str, seed: int) -> None:
    """Damage a bag in place.

    Args:
        folder: of the bag.
        kind: one of `KINDS`.
        seed: seed of place, extent and value.
    """
    draw = random.Random(f'{kind} {seed}')
    path = mcap_file(folder)
    if kind == 'clock':
        _step_clock(folder, draw)
        return
    data = bytearray(path.read_bytes())
    begin = draw.randrange(len(MAGIC), len(data))
    end = min(len(data), begin + int(2 ** draw.uniform(0, 16)))
    if kind == 'bit':
        data[begin] ^= 1 << draw.randrange(8)
    elif kind == 'bytes':
        data[begin:end] = draw.randbytes(end - begin)
    elif kind == 'cut off':
        del data[begin:]
    elif kind == 'cut out':
        del data[begin:end]
    elif kind == 'repeated':
        data[end:end] = data[begin:end]
    else:
        with McapFile(path) as file:
            place = draw.choice(list(file.records(len(MAGIC), file.size)))
        record = data[place.offset : place.end]
        data[place.offset : place.end] = record + record if kind == 'record twice' else b''
    path.write_bytes(data)


def _step_clock(folder: Path, draw: random.Random) -> None:
    bag = open_bag(folder)
    count = sum(1 for _ in bag.messages())
    first, step = draw.randrange(1, count), draw.choice(CLOCK_STEPS_NS)
    stepped = folder.with_name('stepped') / folder.name
    _copy(bag, stepped, bag.topics(), count, 20, lambda at, time: time + step * (at >= first))
    shutil.rmtree(folder)
    stepped.replace(folder)


def _copy(
    bag: Bag,
    folder: Path,
    topics: Collection[str],
    messages: int,
    in_chunk: int,
    clock: Callable[[int, int], int],
) -> Path:
    writer = BagWriter(folder, custom_data=bag.custom_data)
    for topic in topics:
        kind = bag.topics()[topic]
        writer.add_topic(topic, kind, bag.schemas[kind], '', bag.profiles(topic))
    for at, m in zip(range(messages), bag.messages(topics), strict=False):
        writer.write(m.topic, clock(at, m.log_time), m.publish_time, m.data, m.sequence)
        if at % in_chunk == in_chunk - 1:
            writer.flush()
    writer.close()
    return folder


@dataclass
class Heard:
    """Content that a reader got from a file.

    Attributes:
        messages: up to where it stopped.
        refusal: why it stopped, '' where it came to the end.
    """

    messages: Messages = field(default_factory=Counter)
    refusal: str = ''


def by_public_readers(path: Path, *, strict: bool) -> dict[str, Heard]:
    """Read a file with the readers of the MCAP project.

    Args:
        path: the file.
        strict: they check checksums.
    """

    def seeking() -> Iterable[Any]:
        with path.open('rb') as file:
            yield from SeekingReader(file, validate_crcs=strict).iter_messages()

    def streaming() -> Iterable[Any]:
        with path.open('rb') as file:
            reader = NonSeekingReader(file, validate_crcs=strict)
            yield from reader.iter_messages(log_time_order=False)

    def records() -> Iterator[Any]:
        with path.open('rb') as file:
            for _ in StreamReader(file, validate_crcs=strict).records:
                pass
        yield from ()

    readers = {'by index': seeking, 'as a stream': streaming, 'record by record': records}
    return {name: _heard(read()) for name, read in readers.items()}


def _heard(messages: Iterable[Any]) -> Heard:
    heard = Heard()
    try:
        for _, _, m in messages:
            heard.messages[(m.log_time, m.data)] += 1
    except Exception as error:  # damage may raise any error in a parser
        heard.refusal = f'{type(error).__name__}: {error}'
    return heard


def by_rosbags(folder: Path) -> Heard:
    """Read a bag with `rosbags`, which only the requirements of the tests install."""
    from rosbags.highlevel import AnyReader

    heard = Heard()
    try:
        with warnings.catch_warnings(), AnyReader([folder]) as reader:
            warnings.simplefilter('error')
            for _, time, data in reader.messages():
                heard.messages[(time, bytes(data))] += 1
    except Exception as error:  # damage may raise any error in a parser
        heard.refusal = f'{type(error).__name__}: {error}'
    return heard


@dataclass(frozen=True)
class Outcome:
    """Result of one damaged copy.

    Attributes:
        called_whole: `repair` found nothing wrong.
        refused: readers that reject a copy called whole, or the repaired file, with their errors.
        missing: messages that a public reader gets of the damaged copy and that are not kept.
        error: why nothing could be repaired, '' where it was.
    """

    called_whole: bool
    refused: tuple[str, ...]
    missing: int
    error: str


def outcome(folder: Path, *, rosbags: bool = False) -> Outcome:
    """Repair a damaged copy, and compare."""
    before = by_public_readers(mcap_file(folder), strict=False)
    if rosbags:
        before['rosbags'] = by_rosbags(folder)
    try:
        whole = repair_bag(folder).whole
    except ValueError as error:
        lost = max(len(heard.messages) for heard in before.values())
        return Outcome(called_whole=False, refused=(), missing=lost, error=str(error))
    after = by_public_readers(mcap_file(folder), strict=True)
    if rosbags:
        after['rosbags'] = by_rosbags(folder)
    kept = Counter((m.log_time, m.data) for m in open_bag(folder).messages())
    refused = [f'{name}: {heard.refusal}' for name, heard in after.items() if heard.refusal]
    for name, heard in after.items():
        if not heard.refusal and name != 'record by record' and heard.messages != kept:
            refused.append(f'{name}: other messages')
    missing = max(_missing(heard.messages, kept) for heard in before.values())
    return Outcome(whole, tuple(refused), missing, '')


def _missing(heard: Messages, kept: Messages) -> int:
    """Return the number of messages that are not kept.

    One whose length is damaged reads on into the messages after it: its begin has to be kept.
    """
    begins: dict[int, list[bytes]] = {}
    for time, data in kept:
        begins.setdefault(time, []).append(data + _NEXT_MESSAGE)
    return sum(
        not any(data.startswith(begin) for begin in begins.get(time, ()))
        for time, data in heard.keys() - kept.keys()
    )


def main() -> int:
    """Damage copies of a bag and print the failures."""
    source, count = Path(sys.argv[1]), int((sys.argv[2:] or ['300'])[0])
    outcomes = []
    with tempfile.TemporaryDirectory() as temporary:
        for i in range(count):
            kind = KINDS[i % len(KINDS)]
            folder = Path(shutil.copytree(source, Path(temporary) / 'bag' / source.name))
            damage(folder, kind, i)
            came = outcome(folder, rosbags=True)
            outcomes.append(came)
            if came.missing or came.refused or came.error:
                print(f'{i} {kind}: {came}')
            shutil.rmtree(folder.parent)
    whole = sum(came.called_whole for came in outcomes)
    kept = sum(not came.missing for came in outcomes)
    refused = sum(bool(came.refused) for came in outcomes)
    print(f'{count} copies: all that readers get is kept in {kept}, {whole} called whole, ')
    print(
        f'{refused} refused by a reader that checks, {sum(bool(c.error) for c in outcomes)} errors'
    )
    return 0 if kept == count and not refused else 1


if __name__ == '__main__':
    sys.exit(main())
