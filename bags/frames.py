"""What a bag says of each simulation frame: its inputs and the force that came of it."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from bags.errors import BagError
from bags.reader import Bag
from bags.topics import CONTACT, FORCE, INPUTS, MESH, POSE, of_session
from haptic_bridge.wire import ContactCodec, ForceSampleCodec, PoseStampedCodec, Sample
from tissue_sim.refusals import MessageError
from tissue_sim.stamps import nanoseconds

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


@dataclass(frozen=True)
class Restart:
    """Where another process went on with the simulation.

    Attributes:
        step: its first frame.
        seconds: when that was [s] since the first frame of all.
    """

    step: int
    seconds: float


def runs(bag: Bag, topic: str) -> Iterator[tuple[int, Any]]:
    """The messages of a topic of `tissue_sim`, with how often it had been started again before.

    A new process numbers its messages anew; it goes on with the frames as the tissue was known,
    from one that there was already or from the next.
    """
    run = number = step = -1
    for recorded in bag.messages([topic]):
        message = bag.read(recorded)
        if message.step < step or 0 < recorded.sequence <= number or run < 0:
            run += 1
        number, step = recorded.sequence, message.step
        yield run, message


def read_frames(bag: Bag) -> list[FrameRecord]:
    """The frames of a bag in their order, up to where the simulation was started again.

    Raises:
        BagError: the bag does not say what its frames were computed from.
    """
    return read_first_run(bag)[0]


def read_first_run(bag: Bag) -> tuple[list[FrameRecord], Restart | None]:
    """As `read_frames`, and where the simulation was started again; None: nowhere.

    Raises:
        BagError: the bag does not say what its frames were computed from.
    """
    if INPUTS not in bag.topics():
        raise BagError(f'{bag.path} has no topic {INPUTS}: it is older than format version 2')
    inputs: list[Any] = []
    restart = None
    for run, m in runs(bag, INPUTS):
        if run or (inputs and m.step == inputs[-1].step):
            late = nanoseconds(m.header.stamp) - nanoseconds(inputs[0].header.stamp)
            restart = Restart(m.step, late * 1e-9)
            break
        inputs.append(m)
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
    return records, restart


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
        with contextlib.suppress(MessageError):  # which no node has used
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
