"""Start of a re-simulation: the first computable frame of a bag, and the state before it.

A bag that was started with its session has the tissue before the first frame. A bag that was
started in the middle has the whole state at one of its first frames, published for its recorder.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.message_order import Sequence
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_frames import FrameRecord, Segment, last_cut, read_run, segments
from cutting_trainer.bags.topic_names import MEMORY, MESH, STATE
from cutting_trainer.tissue_sim.contact.tool import CutOutcome
from cutting_trainer.tissue_sim.simulation.serialisation import ObjectState

_MAX_PARTS = 1 << 16


@dataclass(frozen=True)
class ComputationStart:
    """Start of the computation of a session.

    Attributes:
        step: of the first frame that can be computed.
        segment: frames of one process that contain it.
        tissue: state of the simulation before it, None: it is the first of the session.
        cutting: state of the cutting service before it; None: the bag lacks it, or has the
            first frame of the session.
    """

    step: int
    segment: Segment
    tissue: ObjectState | None = None
    cutting: ObjectState | None = None

    def frames(self, records: list[FrameRecord]) -> list[FrameRecord]:
        """Return the frames of the segment that can be computed.

        The answer to a cut in the first of them is part of the state already.
        """
        later = [record for record in records if record.step >= self.step]
        if self.tissue is None:
            return later
        return [replace(record, answer=CutOutcome.NO_ANSWER) for record in later[:1]] + later[1:]


def computable_frames(bag: Bag) -> tuple[ComputationStart, list[FrameRecord]]:
    """Return the start of the computation of a session, and its frames up to a restart.

    Raises:
        BagError: no frame can be computed; the message says why.
    """
    beginning = find_beginning(bag)
    frames = beginning.frames(read_run(bag, beginning.segment.run)[0])
    for step, frame in enumerate(frames, beginning.step):
        if frame.step != step:
            raise BagError(f'the bag lacks frame {step}: nothing after it can be computed')
    return beginning, frames


def find_beginning(bag: Bag) -> ComputationStart:
    """Return the first frame of a bag that can be computed.

    Raises:
        BagError: there is none; the message says why.
    """
    found = segments(bag)
    for segment in found:
        if segment.first == 1 and _has_first_tissue(bag, segment):
            return ComputationStart(1, segment)
        if (beginning := _from_state(bag, segment)) is not None:
            return beginning
    lacking = f'{bag.path} begins at frame {found[0].first}'
    if STATE not in bag.topics():
        raise BagError(
            f'{lacking}, and its recorder did not record the state of the tissue there '
            '(bags do from format 3 on): nothing in it can be computed again'
        )
    raise BagError(
        f'{lacking}, and ends before the state of the tissue was recorded, half a second later: '
        'nothing in it can be computed again'
    )


def _from_state(bag: Bag, segment: Segment) -> ComputationStart | None:
    """Return the first state with all data that its frames need, else the first; None: none."""
    memories, cut = dict(_states(bag, MEMORY, segment)), last_cut(bag, segment.run)
    first = None
    for step, state in _states(bag, STATE, segment):
        if segment.first <= step <= segment.last:
            beginning = ComputationStart(step, segment, state, memories.get(step))
            if beginning.cutting is not None or (first is None and cut <= step):
                return beginning
            first = first or beginning
    return first


def _has_first_tissue(bag: Bag, segment: Segment) -> bool:
    return any(
        bag.read(m).step == 0
        for m in Sequence(bag, MESH)
        if segment.since <= m.log_time < segment.until
    )


def _states(bag: Bag, topic: str, segment: Segment) -> Iterator[tuple[int, ObjectState]]:
    """Yield the complete states of a topic, each with its frame."""
    parts: dict[int, dict[int, bytes]] = {}
    trees: dict[int, str] = {}
    for recorded in Sequence(bag, topic) if topic in bag.topics() else ():
        if not segment.since <= recorded.log_time < segment.until:
            continue
        message = bag.read(recorded)
        if not message.part < message.parts <= _MAX_PARTS:
            continue
        some = parts.setdefault(message.step, {})
        some[message.part] = bytes(message.data)
        trees.setdefault(message.step, message.tree)
        if len(some) == message.parts:
            data = b''.join(data for _, data in sorted(some.items()))
            yield message.step, ObjectState(trees[message.step], data)
