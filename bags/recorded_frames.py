"""Recorded inputs and results of each simulation frame."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_order import Sequence
from cutting_trainer.bags.reader import Bag, Recorded
from cutting_trainer.bags.recorded_indexings import indexing_at, recorded_indexings
from cutting_trainer.bags.recorded_tissue import first_current_keyframe
from cutting_trainer.bags.topic_names import (
    CONTACT,
    FORCE,
    INPUTS,
    MESH,
    POSE,
    further_tools,
    of_session,
)
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.node_common.cdr_codec import (
    ContactCodec,
    ForceSampleCodec,
    PoseStampedCodec,
    StampedMessage,
)
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.node_common.stamps import nanoseconds
from cutting_trainer.tissue_sim.contact.tool import CutOutcome

_TRAILING_NS = 100_000_000
_FIRST_WITH_INPUTS = 2
"""Version of the format."""


@dataclass(frozen=True)
class ToolRecord:
    """Contact of one tool with a frame, and its reaction.

    Attributes:
        has_contact: whether a contact loaded the tissue.
        contact: its message, None where the bag lacks it.
        pose: the device pose of that contact, None where the bag lacks it.
        force: `ForceSample` of the frame, None where the bag lacks it.
        indexing: how the hand moved the tool at that pose; None: as the scene says.
    """

    has_contact: bool
    contact: Any
    pose: StampedMessage | None
    force: StampedMessage | None
    indexing: Indexing | None = None


@dataclass(frozen=True)
class FrameRecord:
    """Recorded inputs and results of one frame.

    Attributes:
        step: number of the frame.
        time: when it ended [ns since the epoch].
        has_contact: whether a contact of the first tool loaded the tissue.
        contact: its message, None where the bag lacks it.
        pose: the device pose of that contact, None where the bag lacks it.
        answer: result of the last requested cut (`CutOutcome`).
        cut_step: frame that requested it; 0 without an answer.
        answer_frames: number of frames from the request of a cut to that which applies its
            answer. 0: it was applied on arrival, in bags before format 3.
        diverged: the frame was taken back.
        force: `ForceSample` of the frame, None where the bag lacks it.
        others: contacts of the further tools, by number; None where the bag lacks their inputs.
        indexing: as of a `ToolRecord`, of the first tool.
        concession: see `Frame`.
        answered: stamp of the last device pose recorded before `force` [ns]; 0: not known.
    """

    step: int
    time: int
    has_contact: bool
    contact: Any
    pose: StampedMessage | None
    answer: int
    cut_step: int
    answer_frames: int
    diverged: bool
    force: StampedMessage | None
    others: tuple[ToolRecord | None, ...] = ()
    indexing: Indexing | None = None
    concession: int = 0
    answered: int = 0

    @property
    def by_tool(self) -> tuple[ToolRecord | None, ...]:
        """The contact of each tool."""
        first = ToolRecord(self.has_contact, self.contact, self.pose, self.force, self.indexing)
        return (first, *self.others)


@dataclass(frozen=True)
class Segment:
    """Frames that one process has computed.

    Attributes:
        run: number of processes that had computed frames before.
        first, last: numbers of its frames.
        since, until: log times [ns since the epoch] of its messages; messages between the frames of
            two processes are in the segments of both.
    """

    run: int
    first: int
    last: int
    since: int = 0
    until: int = 1 << 63


@dataclass(frozen=True)
class Restart:
    """Continuation of the simulation by another process.

    Attributes:
        step: its first frame.
        seconds: its time since the first frame of all [s].
    """

    step: int
    seconds: float


def runs(bag: Bag, messages: Iterable[Recorded]) -> Iterator[tuple[int, Recorded, Any]]:
    """Yield the messages of a topic of `tissue_sim` with the number of restarts before each.

    A new process numbers its messages anew. It goes on with the frames from the last known tissue,
    from an existing frame or from the next.

    Args:
        bag: that has them.
        messages: of one topic, in their order.

    Yields:
        Number of restarts, the message as recorded, and the decoded message.
    """
    run = number = step = -1
    for recorded in messages:
        message = bag.read(recorded)
        again = recorded.topic.endswith(INPUTS) and message.step == step
        if message.step < step or again or 0 < recorded.sequence <= number or run < 0:
            run += 1
        number, step = recorded.sequence, message.step
        yield run, recorded, message


def segments(bag: Bag) -> list[Segment]:
    """Return the frames of a bag by the process that computed them, in their order.

    Raises:
        BagError: the bag does not record the inputs of its frames.
    """
    found: list[Segment] = []
    ended = 0
    for run, recorded, message in _inputs(bag):
        now = recorded.log_time
        if run == len(found):
            # The other messages of the process before follow its last frame by a moment.
            since = ended + min(_TRAILING_NS, (now - ended) // 2) if found else 0
            found = [*found[:-1], *(replace(segment, until=now) for segment in found[-1:])]
            found.append(Segment(run, message.step, message.step, since))
        found[-1] = replace(found[-1], last=message.step)
        ended = now
    if not found:
        raise BagError(f'{bag.path} has no message of {INPUTS}: it has no frame')
    return found


def _inputs(bag: Bag, tool: str = '') -> Iterator[tuple[int, Recorded, Any]]:
    if INPUTS not in bag.topics():
        if not bag.complete:
            reason = 'it was cut off before its first frame'
        elif int(bag.custom_data.get('format_version', '1')) < _FIRST_WITH_INPUTS:
            reason = f'it is older than format version {_FIRST_WITH_INPUTS}'
        else:
            reason = 'no tissue was computed while it was recorded'
        raise BagError(f'{bag.path} has no topic {INPUTS}: {reason}')
    return runs(bag, Sequence(bag, f'{tool}{INPUTS}'))


def last_cut(bag: Bag, number: int) -> int:
    """Return the last frame of a process that received a cut by the service; 0: there is none.

    Args:
        bag: to read.
        number: number of processes that had computed frames before.
    """
    made = (CutOutcome.APPLIED, CutOutcome.EMPTY)
    return max(
        (m.step for run, _, m in _inputs(bag) if run == number and m.answer in made), default=0
    )


def read_run(bag: Bag, number: int = 0) -> tuple[list[FrameRecord], Restart | None]:
    """Return the frames of one process, and the restart after it; None: there is none.

    Args:
        bag: to read.
        number: number of processes that had computed frames before.

    Raises:
        BagError: the bag does not record the inputs of its frames.
    """
    inputs: list[Any] = []
    restart = None
    for run, _, m in _inputs(bag):
        if run > number:
            late = nanoseconds(m.header.stamp) - nanoseconds(inputs[0].header.stamp)
            restart = Restart(m.step, late * 1e-9)
            break
        if run == number:
            inputs.append(m)
    others = [
        _tool_records(bag, [m for run, _, m in _inputs(bag, tool) if run == number], tool)
        for tool in _by_number(bag, further_tools(bag.topics()))
    ]
    first = _tool_records(bag, inputs, '')
    records = [
        FrameRecord(
            step=m.step,
            time=nanoseconds(m.header.stamp),
            answer=m.answer,
            cut_step=m.cut_step,
            answer_frames=getattr(m, 'answer_frames', 0),
            diverged=m.diverged,
            others=tuple(other.get(m.step) for other in others),
            concession=getattr(m, 'concession', 0),
            **vars(first[m.step]),
        )
        for m in inputs
    ]
    return records, restart


def _by_number(bag: Bag, tools: Iterable[str]) -> list[str]:
    """Return the further tools of a session in the order of their numbers."""
    numbers = {}
    for tool in tools:
        message = next(iter(bag.messages([f'{tool}{INPUTS}'])), None)
        numbers[tool] = 0 if message is None else bag.read(message).tool
    return sorted((tool for tool in numbers if numbers[tool]), key=lambda tool: numbers[tool])


def _tool_records(bag: Bag, inputs: list[Any], tool: str) -> dict[int, ToolRecord]:
    """Return the contacts of a tool by frame.

    Args:
        bag: to read.
        inputs: its messages of `INPUTS`.
        tool: its namespace with a slash before it; '': the first.
    """
    used = {(m.contact_sequence, nanoseconds(m.contact_stamp)) for m in inputs if m.has_contact}
    pose, wanted = of_session(f'{tool}{POSE}', bag.topics()), {stamp for _, stamp in used}
    stamps = {nanoseconds(m.header.stamp) for m in inputs}
    contacts, poses, forces = _samples(
        bag,
        _Wanted(f'{tool}{CONTACT}', ContactCodec(), lambda s: (s.values[0], s.stamp_ns), used),
        _Wanted(pose, PoseStampedCodec(), lambda s: s.stamp_ns, wanted),
        _Wanted(f'{tool}{FORCE}', ForceSampleCodec(), lambda s: s.stamp_ns, stamps),
    )
    indexings = recorded_indexings(bag, tool)
    found = {}
    for m in inputs:
        stamp = nanoseconds(m.contact_stamp)
        contact = contacts.get((m.contact_sequence, stamp)) if m.has_contact else None
        found[m.step] = ToolRecord(
            has_contact=m.has_contact,
            contact=None if contact is None else contact_message(contact),
            pose=poses.get(stamp) if m.has_contact else None,
            force=forces.get(nanoseconds(m.header.stamp)),
            indexing=indexing_at(indexings, stamp) if m.has_contact else None,
        )
    return found


def contact_message(sample: StampedMessage) -> Any:
    """Return a `Contact` message from the values of its codec."""
    values = {}
    for name, code, count in ContactCodec.layout:
        got = sample.values[ContactCodec.fields[name]]
        array = np.array(got, {'d': np.float64, 'I': np.uint32}.get(code))
        values[name] = got[0] if count == 1 else array
    return SimpleNamespace(**values)


class _Wanted(NamedTuple):
    """Messages of a topic that are to be found.

    Attributes:
        topic: that has them.
        codec: of it.
        key: returns the key of a message.
        keys: of the messages.
    """

    topic: str
    codec: Any
    key: Callable[[StampedMessage], Any]
    keys: set[Any]


def _samples(bag: Bag, *wanted: _Wanted) -> list[dict[Any, StampedMessage]]:
    """Return messages of some topics by their keys, from one pass through the bag."""
    found: list[dict[Any, StampedMessage]] = [{} for _ in wanted]
    by_topic = {one.topic: (one, samples) for one, samples in zip(wanted, found, strict=True)}
    for recorded in bag.messages(by_topic):
        one, samples = by_topic[recorded.topic]
        with contextlib.suppress(MessageError):  # no node has used such a message
            sample = one.codec.decode(recorded.data)
            if (key := one.key(sample)) in one.keys:
                samples[key] = sample
    return found


def first_keyframe(bag: Bag) -> Any:
    """Return the first `Mesh` message of a bag: the tissue before the first frame, if recorded.

    Raises:
        BagError: it has none.
    """
    for recorded in bag.messages([MESH]):
        mesh = bag.read(recorded)
        if mesh.step == 0:
            return mesh
    current = first_current_keyframe(bag)
    if current is None:
        raise BagError(f'{bag.path} has no message of {MESH}: there is no tissue to compute')
    return bag.read(current)
