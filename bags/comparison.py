"""A session computed again, compared with what was recorded, frame by frame and bit for bit.

Another processor adds in another order, and so rounds otherwise: what differs by no more than that
is told, and the comparison goes on.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

import numpy as np

from bags.frames import FrameRecord, Restart, read_first_run, runs
from bags.reader import Bag
from bags.resimulation import Recomputation
from bags.topics import MESH, UPDATES
from haptic_bridge.wire import ForceSampleCodec, Sample
from tissue_sim.contact import Frame
from tissue_sim.replica import MeshReplica, state_hash
from tissue_sim.simulation import TissueSimulation
from tissue_sim.tool_contact import tool_contact

PoseError = Callable[[Sample, Any], float]
"""Takes a device pose and a contact; how far [m] the tool is from where that pose puts it."""
ROUNDING = 1e-9
"""Largest difference, in relation to what was recorded, that counts as rounding. One that matters
grows past it: the computation goes on from its own state, not from what was recorded."""
_QUANTITIES = {
    'force': 'N',
    'position': 'm',
    'stiffness': 'N/m',
    'resistance': 'N',
    'kinetic_energy': 'J',
    'elastic_energy': 'J',
}


class _Differs(Exception):  # noqa: N818
    """What is computed is not what was recorded, in one sentence."""

    def __init__(self, what: str, size: float = np.inf) -> None:
        super().__init__(what)
        self.size = float(size)


class _Lacks(_Differs):
    """A frame cannot be computed from what the bag has."""


@dataclass(frozen=True)
class Difference:
    """Where what is computed first differs from what was recorded.

    Attributes:
        step: frame.
        seconds: its time since the first frame [s].
        what: one sentence.
        size: of it, in relation to what was recorded; infinite where it is not one of numbers.
        lacks: it was not computed, because the bag lost what it would be computed from.
    """

    step: int
    seconds: float
    what: str
    size: float = np.inf
    lacks: bool = False


@dataclass
class Comparison:
    """What a re-simulation came to.

    Attributes:
        frames: computed.
        seconds: of the session that they are [s].
        forces, meshes, hashes, poses: compared.
        missing: what the bag lacks, in number, by a phrase.
        difference: the first of more than rounding, None where there is none.
        restart: where another process went on, from a state that the bag does not have (velocities,
            what the method of cutting remembered): it ends there. None: nowhere.
        rounding: the first difference of no more than `ROUNDING`.
        largest: such difference, in relation to what was recorded.
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
    rounding: Difference | None = None
    largest: float = 0.0

    @property
    def identical(self) -> bool:
        """Whether all that was compared is the same bit for bit."""
        return self.difference is None and self.rounding is None


class RecordedMesh:
    """The tissue as recorded, frame by frame, from keyframes and deltas.

    Args:
        bag: to read.

    Attributes:
        gaps: deltas that did not fit: one before them is missing.
        hashes: of keyframes and deltas that were checked against what they lead to.
    """

    def __init__(self, bag: Bag) -> None:
        self.replica = MeshReplica()
        self.gaps = 0
        self.hashes = 0
        self._deltas = _Ahead(bag, UPDATES)
        self._keyframes = _Ahead(bag, MESH)

    def follow(self, step: int) -> None:
        """Goes on to a frame.

        Raises:
            _Differs: a message of the bag does not lead to its own hash.
        """
        for delta in self._deltas.until(step):
            if not self.replica.apply(delta):
                self.gaps += 1
            else:
                self._check(delta, 'delta')
        for mesh in self._keyframes.until(step):
            if mesh.revision > self.replica.revision:
                self.replica.load(mesh)
            if mesh.revision == self.replica.revision:
                self._check(mesh, 'keyframe')

    def known(self, step: int) -> bool:
        """Whether the replica is what the frame published; false after a gap."""
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
    """Messages of one topic with a step, read one ahead, up to a restart of their publisher."""

    def __init__(self, bag: Bag, topic: str) -> None:
        first = takewhile(lambda of: of[0] == 0, runs(bag, topic))
        self._source: Iterator[Any] = (message for _, message in first)
        self._next = next(self._source, None)

    @property
    def next_base(self) -> int | None:
        """Revision that the next delta starts from; None after the last."""
        return None if self._next is None else int(self._next.base_revision)

    def until(self, step: int) -> Iterator[Any]:
        while self._next is not None and self._next.step <= step:
            message, self._next = self._next, next(self._source, None)
            yield message


def compare(
    bag: Bag,
    computed: Recomputation,
    pose_error: PoseError,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Computes the frames of a bag from their recorded inputs, until one differs or a restart.

    Args:
        bag: to read.
        computed: of the bag's scene, before its first frame.
        pose_error: how far the tool of a contact is from where its pose puts it.
        progress: told how many frames are done, and how many there are.
    """
    recorded = RecordedMesh(bag)
    records, restart = read_first_run(bag)
    comparison = Comparison(restart=restart)
    for i, record in enumerate(records):
        comparison.seconds = (record.time - records[0].time) * 1e-9
        try:
            _check_record(record, i + 1, comparison, pose_error)
            for rounded in _check_frame(record, computed, recorded, comparison):
                comparison.largest = max(comparison.largest, rounded.size)
                comparison.rounding = comparison.rounding or _told(record, comparison, rounded)
        except _Differs as differs:
            comparison.difference = _told(record, comparison, differs)
            break
        comparison.frames += 1
        progress(i + 1, len(records))
    comparison.hashes = recorded.hashes
    if recorded.gaps:
        comparison.missing['deltas that do not fit the one before'] = recorded.gaps
    return comparison


def _told(record: FrameRecord, comparison: Comparison, differs: _Differs) -> Difference:
    lacks = isinstance(differs, _Lacks)
    return Difference(record.step, comparison.seconds, str(differs), differs.size, lacks)


def _check_record(
    record: FrameRecord, step: int, comparison: Comparison, pose_error: PoseError
) -> None:
    if record.step != step:
        raise _Lacks(f'the bag lacks frame {step}: nothing after it can be computed')
    if record.has_contact and record.contact is None:
        raise _Lacks('the bag lacks the contact that loaded this frame: it cannot be computed')
    if record.has_contact and record.pose is None:
        comparison.missing['poses of the device'] += 1
    elif record.pose is not None:
        comparison.poses += 1
        if distance := pose_error(record.pose, record.contact):
            text = f'the pose of the device puts the tool {distance:.3g} m from its contact'
            raise _Differs(text, distance)


def _check_frame(
    record: FrameRecord, computed: Recomputation, recorded: RecordedMesh, comparison: Comparison
) -> Iterator[_Differs]:
    """Computes one frame and compares what came of it; gives differences by rounding."""
    if what := computed.take_answer(record.answer):
        raise _Differs(what)
    simulation = computed.simulation
    try:
        contact = record.contact and tool_contact(record.contact, simulation.mesh)
    except ValueError as error:
        raise _Differs(f'the contact that loaded this frame is refused now: {error}') from None
    frame = computed.frame(contact)
    if frame.diverged != record.diverged:
        raise _Differs(f'it {("did not diverge", "diverged")[record.diverged]} when recorded')
    if record.force is not None:
        comparison.forces += 1
        yield from _check_force(frame, simulation.mesh.topology, record.force)
    elif not record.diverged:
        comparison.missing['forces of the tissue'] += 1
    recorded.follow(record.step)
    if not recorded.known(record.step):
        comparison.missing['meshes'] += 1
        return
    comparison.meshes += 1
    yield from _check_mesh(simulation, recorded.replica)


def _unless_rounded(what: str, size: float) -> _Differs:
    """A difference of numbers, if it may be one by rounding; raised if it is not."""
    differs = _Differs(what, size)
    if not size <= ROUNDING:
        raise differs
    return differs


def _check_force(frame: Frame, topology: int, sample: Sample) -> Iterator[_Differs]:
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
