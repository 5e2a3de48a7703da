"""Copies of bags in which something is otherwise, and the processor that computed a bag."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from cutting_trainer.bags.metadata import read_metadata
from cutting_trainer.bags.reader import Recorded, open_bag
from cutting_trainer.bags.topic_names import POSE
from cutting_trainer.bags.writer import BagWriter
from cutting_trainer.node_common.cdr_codec import PoseStampedCodec
from cutting_trainer.node_common.code_identity import identity_here, identity_of


def is_of_this_processor(folder: Path) -> bool:
    """Return whether a bag's kernels were compiled for this kind of processor.

    Only then is a computation the same bit for bit. On another kind the rounding grows where an
    edge slips.
    """
    code = identity_of(open_bag(folder).custom_data)
    return code is not None and code.is_of_processor_of(identity_here())


def copies_by_subjects(source: Path, folder: Path, *subjects: str) -> None:
    """Copies of a bag by other subjects, in folders a, b, and so on; each has its own hash."""
    for name, subject in zip('abcdefgh', subjects, strict=False):
        shutil.copytree(source, folder / name)
        file = folder / name / 'metadata.yaml'
        text = file.read_text().replace('custom_data:', f'custom_data:\n    subject: {subject}', 1)
        file.write_text(f'{text}\n# {name}\n')
        assert open_bag(folder / name).custom_data['subject'] == subject


def rewritten(
    source: Path,
    target: Path,
    change: Callable[[Recorded], bytes | None] = lambda recorded: recorded.data,
    added: Iterable[tuple[str, int, bytes]] = (),
    number: Callable[[Recorded], int] = lambda recorded: recorded.sequence,
) -> Path:
    """A copy of a bag in which messages are changed, or left out where `change` returns None.

    Args:
        source, target: folders.
        change: the new data of a message.
        added: topic, time [ns since the epoch] and data of messages that are new.
        number: of a message, in the sequence of its publisher.
    """
    bag = open_bag(source)
    writer = BagWriter(target, custom_data=read_metadata(source)['custom_data'])
    for topic, kind in bag.topics().items():
        writer.add_topic(topic, kind, bag.schemas[kind], '', bag.profiles(topic))
    for m in bag.messages():
        if (data := change(m)) is not None:
            writer.write(m.topic, m.log_time, m.publish_time, data, number(m))
    for topic, time, data in added:
        writer.write(topic, time, time, data)
    writer.close()
    return target


def moved_by(distance: float, stamp_ns: int) -> Callable[[Recorded], bytes]:
    """Changes the one device pose of a stamp by a distance along x [m]."""
    codec = PoseStampedCodec('arm_base')

    def change(m: Recorded) -> bytes:
        sample = codec.decode(m.data) if m.topic == POSE else None
        if sample is None or sample.stamp_ns != stamp_ns:
            return m.data
        x, *rest = sample.values
        return codec.encode(sample.stamp_ns, (x + distance, *rest))

    return change
