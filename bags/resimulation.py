"""A session computed again from its bag, and compared with what was recorded; no ROS.

A frame depends on the state before it, on the contact that was newest when it began, and on the
answer to a cut that it found. `tissue/frame_inputs` names both for every frame.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np

from bags.errors import BagError
from bags.reader import Bag
from bags.topics import CONTACT, FORCE, INPUTS, MESH, POSE, UPDATES, of_session
from cutting.method import CutMethod, CutResult, SweepError, check_sweep
from haptic_bridge.wire import ContactCodec, ForceSampleCodec, PoseStampedCodec, Sample
from tissue_sim.mesh import TetMesh
from tissue_sim.replica import MeshReplica, state_hash
from tissue_sim.simulation import Command, Frame, TissueSimulation, ToolContact
from tissue_sim.tool_contact import tool_contact

NO_ANSWER, APPLIED, EMPTY, REFUSED, LOST = range(5)
"""The numbers of `FrameInputs.answer`."""
PoseError = Callable[[Sample, Any], float]
"""Takes a device pose and a contact; how far [m] the tool is from where that pose puts it."""


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


class Recomputation:
    """The simulation and, beside it, the cutting service with its own mesh, as live.

    Args:
        simulation: of the scene, before its first frame.
        method: of cutting.

    Attributes:
        area: of the incision, one side, at rest [m^2].
    """

    def __init__(self, simulation: TissueSimulation, method: CutMethod) -> None:
        self.simulation = simulation
        self.area = 0.0
        self._method = method
        self._asked: tuple[Frame, np.ndarray] | None = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        mesh = self.simulation.mesh
        self._method.abort()
        self._mesh = TetMesh(mesh.rest, mesh.tetrahedra, mesh.fixed)
        self._mesh.topology = mesh.topology
        self._mesh.set_kinds(mesh.triangles, mesh.triangle_kind)
        self._outdated = False

    def take_answer(self, answer: int) -> str:
        """Does what a frame found of a cut.

        Args:
            answer: as recorded.

        Returns:
            Why that cannot be, '' when all is well.
        """
        if answer == NO_ANSWER:
            return ''
        if self._asked is None:
            return 'a cut was answered that is not asked for now'
        frame, displacement = self._asked
        self._asked = None
        if answer in (REFUSED, LOST):
            self._outdated |= answer == LOST
            self.simulation.cut_failed()
            return ''
        try:
            result = self._cut(frame, displacement)
        except SweepError as error:
            return f'the cut of frame {frame.step} was made, and is refused now: {error}'
        if result.delta.empty != (answer == EMPTY):
            done = ('something', 'nothing')[answer == EMPTY]
            return f'the cut of frame {frame.step} changed {done}, and does not so now'
        self._apply(result)
        return ''

    def answer(self) -> None:
        """Cuts what was asked for and takes the answer, whatever it is."""
        if self._asked is None:
            return
        (frame, displacement), self._asked = self._asked, None
        try:
            self._apply(self._cut(frame, displacement))
        except SweepError:
            self.simulation.cut_failed()

    def frame(self, contact: ToolContact | None) -> Frame:
        """Computes a frame."""
        frame = self.simulation.frame(contact)
        if frame.command is not None:
            self._asked = (frame, self.simulation.displacement.copy())
        return frame

    def _cut(self, frame: Frame, displacement: np.ndarray) -> CutResult:
        if self._outdated:
            self._begin_anew()
        positions = self._mesh.rest + displacement
        if frame.command == Command.FINISH:
            return self._method.finish(self._mesh, positions)
        assert frame.sweep is not None
        check_sweep(frame.sweep)
        return self._method.advance(self._mesh, positions, frame.sweep)

    def _apply(self, result: CutResult) -> None:
        self.area += result.report.area
        if result.delta.empty:
            self.simulation.cut_done()
        else:
            self._mesh.apply(result.delta)
            self.simulation.apply_cut(result.delta)


@dataclass(frozen=True)
class Difference:
    """Where what is computed first differs from what was recorded.

    Attributes:
        step: frame.
        seconds: its time since the first frame [s].
        what: one sentence.
    """

    step: int
    seconds: float
    what: str


@dataclass
class Comparison:
    """What a re-simulation came to.

    Attributes:
        frames: computed.
        seconds: of the session that they are [s].
        forces, meshes, hashes, poses: compared.
        missing: what the bag lacks, in number, by a phrase.
        difference: the first, None when all that was compared is identical.
    """

    frames: int = 0
    seconds: float = 0.0
    forces: int = 0
    meshes: int = 0
    hashes: int = 0
    poses: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    difference: Difference | None = None


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

    def follow(self, step: int) -> str:
        """Goes on to a frame.

        Returns:
            What is wrong with the record, '' when nothing is.
        """
        for delta in self._deltas.until(step):
            if not self.replica.apply(delta):
                self.gaps += 1
            elif wrong := self._check(delta, 'delta'):
                return wrong
        for mesh in self._keyframes.until(step):
            if mesh.revision > self.replica.revision:
                self.replica.load(mesh)
            if mesh.revision == self.replica.revision and (wrong := self._check(mesh, 'keyframe')):
                return wrong
        return ''

    def known(self, step: int) -> bool:
        """Whether the replica is what the frame published; false after a gap."""
        return self._deltas.next_base in (None, self.replica.revision) and step >= self.replica.step

    def _check(self, message: Any, kind: str) -> str:
        if message.revision != self.replica.revision or not message.state_hash:
            return ''
        self.hashes += 1
        if message.state_hash != self.replica.hash():
            return f'the {kind} of revision {message.revision} does not lead to its own hash'
        return ''


class _Ahead:
    """Messages of one topic with a step, read one ahead."""

    def __init__(self, bag: Bag, topic: str) -> None:
        self._source: Iterator[Any] = (bag.read(recorded) for recorded in bag.messages([topic]))
        self._next = next(self._source, None)

    @property
    def next_base(self) -> int | None:
        """Revision that the next delta starts from; None after the last."""
        return None if self._next is None else int(self._next.base_revision)

    def until(self, step: int) -> Iterator[Any]:
        while self._next is not None and self._next.step <= step:
            message, self._next = self._next, next(self._source, None)
            yield message


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


def compare(
    bag: Bag,
    computed: Recomputation,
    pose_error: PoseError,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Computes the frames of a bag from their recorded inputs, until one differs.

    Args:
        bag: to read.
        computed: of the bag's scene, before its first frame.
        pose_error: how far the tool of a contact is from where its pose puts it.
        progress: told how many frames are done, and how many there are.
    """
    comparison = Comparison()
    recorded = RecordedMesh(bag)
    records = read_frames(bag)

    for i, record in enumerate(records):
        what = recorded.follow(record.step - 1) if i == 0 else ''
        what = what or _difference(record, i + 1, computed, recorded, comparison, pose_error)
        comparison.seconds = (record.time - records[0].time) * 1e-9
        comparison.hashes = recorded.hashes
        if what:
            comparison.difference = Difference(record.step, comparison.seconds, what)
            break
        comparison.frames += 1
        progress(i + 1, len(records))
    if recorded.gaps:
        comparison.missing['deltas that do not fit the one before'] = recorded.gaps
    return comparison


def _difference(
    record: FrameRecord,
    step: int,
    computed: Recomputation,
    recorded: RecordedMesh,
    comparison: Comparison,
    pose_error: PoseError,
) -> str:
    """Computes one frame; says what about it differs, '' for nothing."""
    if record.step != step:
        return f'the bag lacks frame {step}: nothing after it can be computed'
    if record.has_contact and record.contact is None:
        return 'the bag lacks the contact that loaded this frame: it cannot be computed'
    if record.has_contact and record.pose is None:
        comparison.missing['poses of the device'] += 1
    elif record.pose is not None:
        comparison.poses += 1
        if distance := pose_error(record.pose, record.contact):
            return f'the pose of the device puts the tool {distance:.3g} m from its contact'
    if what := computed.take_answer(record.answer):
        return what
    simulation = computed.simulation
    try:
        contact = record.contact and tool_contact(record.contact, simulation.mesh.node_count)
    except ValueError as error:
        return f'the contact that loaded this frame is refused now: {error}'
    frame = computed.frame(contact)
    if frame.diverged != record.diverged:
        return f'it {("did not diverge", "diverged")[record.diverged]} when recorded'
    if record.force is not None:
        comparison.forces += 1
        if what := _force_difference(frame, simulation.mesh.topology, record.force):
            return what
    elif not record.diverged:
        comparison.missing['forces of the tissue'] += 1
    if what := recorded.follow(record.step):
        return what
    if not recorded.known(record.step):
        comparison.missing['meshes'] += 1
        return ''
    comparison.meshes += 1
    return _mesh_difference(simulation, recorded.replica)


def _force_difference(frame: Frame, topology: int, sample: Sample) -> str:
    get = ForceSampleCodec.fields

    def was(name: str) -> np.ndarray:
        return np.array(sample.values[get[name]], float)

    if topology != was('topology')[0]:
        return f'connectivity has changed {topology} times, was {was("topology")[0]:.0f}'
    if frame.state != was('state')[0]:
        return f'the tool is {frame.state.name}, was state {was("state")[0]:.0f}'
    quantities = (
        ('force', 'N'),
        ('position', 'm'),
        ('stiffness', 'N/m'),
        ('resistance', 'N'),
        ('kinetic_energy', 'J'),
        ('elastic_energy', 'J'),
    )
    for name, unit in quantities:
        off = np.abs(np.ravel(getattr(frame, name)) - was(name)).max()
        if off != 0.0:
            return f'{name} differs by {off:.3g} {unit}, of {np.abs(was(name)).max():.3g} {unit}'
    return ''


def _mesh_difference(simulation: TissueSimulation, replica: MeshReplica) -> str:
    mesh, u = simulation.mesh, simulation.displacement
    ours = state_hash(mesh.rest, u, mesh.tetrahedra)
    if ours == replica.hash():
        return ''
    same = np.array_equal(mesh.tetrahedra, replica.tetrahedra)
    if not same or len(mesh.rest) != len(replica.rest):
        counts = f'{len(mesh.tetrahedra)} tetrahedra, was {len(replica.tetrahedra)}'
        return f'the tetrahedra are not those recorded: {counts}'
    off = max(np.abs(mesh.rest - replica.rest).max(), np.abs(u - replica.displacement).max())
    return f'the mesh has another hash: a node is off by {off:.3g} m'
