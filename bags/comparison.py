"""Comparison of a re-simulated session with its recording, frame by frame and bit for bit.

Another processor adds in another order, and so rounds differently. A difference of that size is
reported, and the comparison goes on.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

import numpy as np

from cutting_trainer.bags.message_order import Sequence
from cutting_trainer.bags.reader import Bag, Recorded
from cutting_trainer.bags.recorded_frames import (
    FrameRecord,
    Restart,
    Segment,
    ToolRecord,
    read_run,
    runs,
)
from cutting_trainer.bags.resimulation import (
    LACKS_MEMORY,
    Resimulation,
    lacking_contact,
    recorded_contacts,
)
from cutting_trainer.bags.resimulation_start import ComputationStart
from cutting_trainer.bags.topic_names import INPUTS, MESH, UPDATES
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, StampedMessage
from cutting_trainer.tissue_sim.contact.tool import Frame
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica, state_hash
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

PoseError = Callable[[ToolRecord, int], float]
"""Returns the distance [m] of the tool of a contact from the place that its device pose gives,
for the number of the tool."""
MAX_ROUNDING = 1e-9
"""Largest relative difference that counts as rounding. A difference that matters grows beyond it:
the computation goes on from its own state, not from the recorded one."""
_QUANTITIES = {
    'force': 'N',
    'position': 'm',
    'stiffness': 'N/m',
    'resistance': 'N',
    'kinetic_energy': 'J',
    'elastic_energy': 'J',
}


class _Differs(Exception):  # noqa: N818
    """A computed value differs from the recorded one; the message is a sentence."""

    def __init__(self, what: str, size: float = np.inf) -> None:
        super().__init__(what)
        self.size = float(size)


class _Lacks(_Differs):
    """A frame cannot be computed from the data in the bag."""


@dataclass(frozen=True)
class Difference:
    """First difference of the computation from the recording.

    Attributes:
        step: frame.
        seconds: its time since the first frame [s].
        what: the difference, one sentence.
        size: relative to the recorded value; infinite where it is not one of numbers.
        lacks: the frame was not computed, because the bag lost data that it needs.
    """

    step: int
    seconds: float
    what: str
    size: float = np.inf
    lacks: bool = False


@dataclass
class Comparison:
    """Result of a re-simulation.

    Attributes:
        frames: computed.
        seconds: duration of these frames [s].
        forces, meshes, hashes, poses: numbers of those compared.
        missing: number of lacking items in the bag, by a phrase.
        difference: the first beyond rounding, None where there is none.
        restart: continuation by another process, from a state that the bag does not have
            (velocities, memory of the cutting method): the comparison ends there. None: nowhere.
        begins: the first frame that was computed.
        doubled: messages that the bag has once more.
        rounding: the first difference of no more than `MAX_ROUNDING`.
        largest: largest such difference, relative to the recorded value.
    """

    frames: int = 0
    seconds: float = 0.0
    forces: int = 0
    meshes: int = 0
    hashes: int = 0
    poses: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    difference: Difference | None = None
    restart: Restart | None = None
    begins: int = 1
    doubled: int = 0
    rounding: Difference | None = None
    largest: float = 0.0

    @property
    def identical(self) -> bool:
        """Return whether all compared values are the same bit for bit."""
        return self.difference is None and self.rounding is None


class RecordedMesh:
    """Reconstructs the recorded tissue, frame by frame, from keyframes and deltas.

    Args:
        bag: to read.
        beginning: of its computation.

    Attributes:
        doubled: messages that the bag has once more.
        gaps: deltas that did not fit: one before them is missing. None has to fit before a state,
            and its keyframe, that was recorded in the middle of a session.
        hashes: number of keyframes and deltas whose hash was verified.
    """

    def __init__(self, bag: Bag, beginning: ComputationStart) -> None:
        since = beginning.segment.since
        self._begins = beginning.step if beginning.tissue else 0
        self.replica = MeshReplica()
        self.gaps = 0
        self.hashes = 0
        deltas, keyframes = Sequence(bag, UPDATES), Sequence(bag, MESH)
        self.doubled = deltas.doubled + keyframes.doubled
        self._deltas = _Ahead(bag, deltas, since)
        self._keyframes = _Ahead(bag, keyframes, since)

    def follow(self, step: int) -> None:
        """Apply the messages up to a frame.

        Raises:
            _Differs: the hash of a message does not match the tissue.
        """
        for delta in self._deltas.until(step):
            if not self.replica.apply(delta):
                self.gaps += delta.step > self._begins
            else:
                self._check(delta, 'delta')
        for mesh in self._keyframes.until(step):
            if mesh.revision > self.replica.revision:
                self.replica.load(mesh)
            if mesh.revision == self.replica.revision:
                self._check(mesh, 'keyframe')

    def known(self, step: int) -> bool:
        """Return whether the replica equals the published tissue of a frame; false after a gap."""
        unchanged = self._deltas.next_base in (None, self.replica.revision)
        return self.replica.step == step or unchanged

    def _check(self, message: Any, kind: str) -> None:
        if message.revision != self.replica.revision or not message.state_hash:
            return
        self.hashes += 1
        if message.state_hash != self.replica.hash():
            text = f'the {kind} of revision {message.revision} does not lead to its own hash'
            raise _Differs(text)


class _Ahead:
    """Iterates over messages of one topic with a step, one ahead, up to a publisher's restart."""

    def __init__(self, bag: Bag, messages: Iterable[Recorded], since: int) -> None:
        later = (recorded for recorded in messages if recorded.log_time >= since)
        first = takewhile(lambda of: of[0] == 0, runs(bag, later))
        self._source: Iterator[Any] = (message for *_, message in first)
        self._next = next(self._source, None)

    @property
    def next_base(self) -> int | None:
        """Return the revision from which the next delta starts; None after the last."""
        return None if self._next is None else int(self._next.base_revision)

    def until(self, step: int) -> Iterator[Any]:
        while self._next is not None and self._next.step <= step:
            message, self._next = self._next, next(self._source, None)
            yield message


def compare(
    bag: Bag,
    computed: Resimulation,
    pose_error: PoseError,
    progress: Callable[[int, int], None] = lambda done, total: None,
    beginning: ComputationStart | None = None,
) -> Comparison:
    """Compute the frames of a bag from their recorded inputs, until one differs or a restart.

    Args:
        bag: to read.
        computed: of the bag's scene, before its first frame.
        beginning: the start of the computation; None: the first frame of the session.
        pose_error: returns the distance of a contact's tool from the place of its pose.
        progress: called with the number of computed frames and of all frames.
    """
    start = beginning or ComputationStart(1, Segment(0, 1, 1))
    recorded = RecordedMesh(bag, start)
    every, restart = read_run(bag, start.segment.run)
    records = start.frames(every)
    comparison = Comparison(restart=restart, begins=start.step, doubled=recorded.doubled)
    comparison.doubled += Sequence(bag, INPUTS).doubled
    for i, record in enumerate(records):
        comparison.seconds = (record.time - records[0].time) * 1e-9
        try:
            _check_record(record, start.step + i, comparison, pose_error)
            for rounded in _check_frame(record, computed, recorded, comparison):
                comparison.largest = max(comparison.largest, rounded.size)
                comparison.rounding = comparison.rounding or _as_difference(
                    record, comparison, rounded
                )
        except _Differs as differs:
            comparison.difference = _as_difference(record, comparison, differs)
            break
        comparison.frames += 1
        progress(i + 1, len(records))
    comparison.hashes = recorded.hashes
    if recorded.gaps:
        comparison.missing['deltas that do not fit the one before'] = recorded.gaps
    return comparison


def _as_difference(record: FrameRecord, comparison: Comparison, differs: _Differs) -> Difference:
    lacks = isinstance(differs, _Lacks)
    return Difference(record.step, comparison.seconds, str(differs), differs.size, lacks)


def _check_record(
    record: FrameRecord, step: int, comparison: Comparison, pose_error: PoseError
) -> None:
    if record.step != step:
        raise _Lacks(f'the bag lacks frame {step}: nothing after it can be computed')
    if lacks := lacking_contact(record):
        raise _Lacks(f'{lacks}: it cannot be computed')
    for number, tool in enumerate(record.by_tool):
        assert tool is not None
        if tool.has_contact and tool.pose is None:
            comparison.missing['poses of the device'] += 1
        elif tool.pose is not None:
            comparison.poses += 1
            if distance := pose_error(tool, number):
                text = f'the pose of the device puts the tool {distance:.3g} m from its contact'
                raise _Differs(text, distance)


def _check_frame(
    record: FrameRecord, computed: Resimulation, recorded: RecordedMesh, comparison: Comparison
) -> Iterator[_Differs]:
    """Compute one frame and compare its results; yield differences by rounding."""
    if what := computed.take_answer(record.answer):
        raise (_Lacks if what == LACKS_MEMORY else _Differs)(what)
    simulation = computed.simulation
    try:
        contacts = recorded_contacts(record, simulation.mesh)
    except ValueError as error:
        raise _Differs(f'the contact that loaded this frame is refused now: {error}') from None
    frame = computed.frame(*contacts, concession=record.concession)
    if frame.diverged != record.diverged:
        raise _Differs(f'it {("did not diverge", "diverged")[record.diverged]} when recorded')
    for felt, tool in zip(frame.by_tool, record.by_tool, strict=True):
        assert tool is not None
        if tool.force is not None:
            comparison.forces += 1
            yield from _check_force(felt, simulation.mesh.topology, tool.force)
        elif not record.diverged:
            comparison.missing['forces of the tissue'] += 1
    recorded.follow(record.step)
    if not recorded.known(record.step):
        comparison.missing['meshes'] += 1
        return
    comparison.meshes += 1
    yield from _check_mesh(simulation, recorded.replica)


def _unless_rounded(what: str, size: float) -> _Differs:
    """Return a difference of numbers if it may be rounding; raise it otherwise."""
    differs = _Differs(what, size)
    if not size <= MAX_ROUNDING:
        raise differs
    return differs


def _check_force(frame: Frame, topology: int, sample: StampedMessage) -> Iterator[_Differs]:
    get = ForceSampleCodec.fields

    def was(name: str) -> np.ndarray:
        return np.array(sample.values[get[name]], float)

    if topology != was('topology')[0]:
        raise _Differs(f'connectivity changed {topology} times, was {was("topology")[0]:.0f}')
    if frame.state != was('state')[0]:
        raise _Differs(f'the tool is {frame.state.name}, was state {was("state")[0]:.0f}')
    for name, unit in _QUANTITIES.items():
        off = np.abs(np.ravel(getattr(frame, name)) - was(name)).max()
        if off != 0.0:
            size = np.abs(was(name)).max()
            text = f'{name} differs by {off:.3g} {unit}, of {size:.3g} {unit}'
            yield _unless_rounded(text, off / max(size, 1e-300))


def _check_mesh(simulation: TissueSimulation, replica: MeshReplica) -> Iterator[_Differs]:
    mesh, u = simulation.mesh, simulation.displacement
    if state_hash(mesh.rest, u, mesh.tetrahedra) == replica.hash():
        return
    same = np.array_equal(mesh.tetrahedra, replica.tetrahedra)
    if not same or len(mesh.rest) != len(replica.rest):
        counts = f'{len(mesh.tetrahedra)} tetrahedra, was {len(replica.tetrahedra)}'
        raise _Differs(f'the tetrahedra are not those recorded: {counts}')
    off = max(np.abs(mesh.rest - replica.rest).max(), np.abs(u - replica.displacement).max())
    size = np.ptp(replica.rest, axis=0).max()
    text = f'the mesh has another hash: a node is off by {off:.3g} m'
    yield _unless_rounded(text, off / size)
