"""What a bag says of each simulation frame: its inputs and the force that came of it."""

from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np

from bags.errors import BagError
from bags.reader import Bag
from bags.topics import CONTACT, FORCE, INPUTS, MESH, POSE, of_session
from haptic_bridge.wire import ContactCodec, ForceSampleCodec, PoseStampedCodec, Sample

NO_ANSWER, APPLIED, EMPTY, REFUSED, LOST, GIVEN_UP = range(6)
"""The numbers of `FrameInputs.answer`."""


@dataclass(frozen=True)
class FrameRecord:
    """What a bag has on one frame.

    Attributes:
        step: number of the frame.
        time: when it ended [ns since the epoch].
        has_contact: whether a contact loaded the tissue.
        contact: its message, None where the bag lacks it.
        pose: the device pose that it stems from, None where the bag lacks it.
        answer: what came of the cut asked for last.
        diverged: the frame was taken back.
        force: `ForceSample` of the frame, None where the bag lacks it.
    """

    step: int
    time: int
    has_contact: bool
    contact: Any
    pose: Sample | None
    answer: int
    diverged: bool
    force: Sample | None


def read_frames(bag: Bag) -> list[FrameRecord]:
    """The frames of a bag in their order, up to where the simulation was started anew.

    Raises:
        BagError: the bag does not say what its frames were computed from.
    """
    if INPUTS not in bag.topics():
        raise BagError(f'{bag.path} has no topic {INPUTS}: it is older than format version 2')
    inputs = [bag.read(recorded) for recorded in bag.messages([INPUTS])]
    for i, (before, after) in enumerate(pairwise(inputs)):
        if after.step <= before.step:
            del inputs[i + 1 :]
            break
    used = {(m.contact_sequence, nanoseconds(m.contact_stamp)) for m in inputs if m.has_contact}
    contacts = _samples(bag, CONTACT, ContactCodec(), lambda s: (s.values[0], s.stamp_ns), used)
    pose, wanted = of_session(POSE, bag.topics()), {stamp for _, stamp in used}
    poses = _samples(bag, pose, PoseStampedCodec(), lambda s: s.stamp_ns, wanted)
    stamps = {nanoseconds(m.header.stamp) for m in inputs}
    forces = _samples(bag, FORCE, ForceSampleCodec(), lambda s: s.stamp_ns, stamps)
    records = []
    for m in inputs:
        time, stamp = nanoseconds(m.header.stamp), nanoseconds(m.contact_stamp)
        contact = contacts.get((m.contact_sequence, stamp)) if m.has_contact else None
        records.append(
            FrameRecord(
                step=m.step,
                time=time,
                has_contact=m.has_contact,
                contact=None if contact is None else contact_message(contact),
                pose=poses.get(stamp) if m.has_contact else None,
                answer=m.answer,
                diverged=m.diverged,
                force=forces.get(time),
            )
        )
    return records


def nanoseconds(stamp: Any) -> int:
    """A time stamp in a message [ns]."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def contact_message(sample: Sample) -> Any:
    """A `Contact` message from the values of its codec."""
    values = {}
    for name, code, count in ContactCodec.layout:
        got = sample.values[ContactCodec.fields[name]]
        array = np.array(got, {'d': np.float64, 'I': np.uint32}.get(code))
        values[name] = got[0] if count == 1 else array
    return SimpleNamespace(**values)


def _samples(bag: Bag, topic: str, codec: Any, key: Any, wanted: set[Any]) -> dict[Any, Sample]:
    found = {}
    for recorded in bag.messages([topic]):
        sample = codec.decode(recorded.data)
        if key(sample) in wanted:
            found[key(sample)] = sample
    return found


def first_keyframe(bag: Bag) -> Any:
    """The `Mesh` message of the tissue before its first frame.

    Raises:
        BagError: the bag begins later.
    """
    for recorded in bag.messages([MESH]):
        mesh = bag.read(recorded)
        if mesh.step == 0:
            return mesh
        raise BagError(
            f'{bag.path} begins at frame {mesh.step}: only a session that was recorded from its '
            'start can be computed again, because velocities are not recorded'
        )
    raise BagError(f'{bag.path} has no message of {MESH}: there is no tissue to compute')
