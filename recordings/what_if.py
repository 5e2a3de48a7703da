"""A recorded hand on a changed tissue: the poses are recorded, all else is recomputed.

Proxy, tissue and cutting run together without ROS. Each recorded pose is a tick of the force loop,
and each frame of the tissue comes at the same pose as in the session, as does its answer. A cut is
answered after as many frames as in the session. The hand does not yield to the force: it follows
the recorded path. The result is compared with the recorded session, of which only the tissue is
recomputed.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from cutting_trainer.bags.comparison import MAX_ROUNDING
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_frames import FrameRecord, contact_message
from cutting_trainer.bags.recorded_indexings import recorded_indexings
from cutting_trainer.bags.resimulation import Resimulation, answer_frames, as_recorded
from cutting_trainer.exercises.bag_feed import add_samples, motion_of
from cutting_trainer.exercises.metrics import Attempt
from cutting_trainer.haptic_bridge.force_kernels import NONE
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.node_common.cdr_codec import (
    ForceSampleCodec,
    StampedMessage,
    WrenchStampedCodec,
)
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.recordings.recorded_hand import (
    RecordedForce,
    computable_poses,
    recorded_force,
    times_of_frame,
)
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.in_process import make_force_path
from cutting_trainer.session.scene_loader import Scene
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.contact.tool import Frame, ToolContact, ToolMode

_NANOSECOND_S = 1e-9


@dataclass
class Run:
    """Result of one computation of a session.

    Attributes:
        times: times of the ticks since the first pose [s], shape (n,).
        forces: norm of the force on the hand [N], shape (n,).
        contact: contact flag, shape (n,).
        vectors: force on the hand in the frame of the device [N], shape (n, 3).
        area: area of the incision, one side, at rest [m^2].
        elements_cut: number of tetrahedra removed by cuts.
        tetrahedra: number of tetrahedra at the end.
        substeps: number of substeps of all frames.
        diverged: number of frames rolled back.
    """

    times: np.ndarray
    forces: np.ndarray
    contact: np.ndarray
    vectors: np.ndarray
    area: float
    elements_cut: int
    tetrahedra: int
    substeps: int
    diverged: int

    def table(self, changed: 'Run', changes: Mapping[str, str]) -> Table:
        """Return a table of this run and a changed one."""
        title = ', '.join(f'{key}={value}' for key, value in changes.items())
        table = Table(title=title, box=box.SIMPLE_HEAD)
        for column in ('', 'as recorded', 'changed', 'difference'):
            table.add_column(column, justify='right' if column else 'left')
        for name, digits, before, after in (
            ('largest force on the hand [N]', 3, self.peak, changed.peak),
            ('mean force in contact [N]', 3, self.mean, changed.mean),
            ('contact [s]', 2, self.contact_time, changed.contact_time),
            ('area of the incision [cm^2]', 3, self.area * 1e4, changed.area * 1e4),
            ('elements cut', 0, self.elements_cut, changed.elements_cut),
            ('tetrahedra at the end', 0, self.tetrahedra, changed.tetrahedra),
            ('substeps', 0, self.substeps, changed.substeps),
            ('frames rolled back', 0, self.diverged, changed.diverged),
        ):
            cells = (f'{before:.{digits}f}', f'{after:.{digits}f}', f'{after - before:+.{digits}f}')
            table.add_row(escape(name), *cells)
        off = np.abs(changed.forces - self.forces)
        at = int(off.argmax())
        table.add_row(
            'force at the same moment, rms [N]', '', '', f'{np.sqrt(np.mean(off**2)):.3f}'
        )
        where = f'force, farthest apart [N], at {self.times[at]:.2f} s'
        table.add_row(
            where, f'{self.forces[at]:.3f}', f'{changed.forces[at]:.3f}', f'{off[at]:.3f}'
        )
        return table

    def figures(self) -> dict[str, float]:
        """Return the figures in SI units, for JSON."""
        return {
            'largest_force': self.peak,
            'mean_force_in_contact': self.mean,
            'contact': self.contact_time,
            'incision_area': self.area,
            'elements_cut': self.elements_cut,
            'tetrahedra': self.tetrahedra,
            'substeps': self.substeps,
            'frames_taken_back': self.diverged,
        }

    @property
    def peak(self) -> float:
        return float(self.forces.max(initial=0.0))

    @property
    def mean(self) -> float:
        return float(self.forces[self.contact].mean()) if self.contact.any() else 0.0

    @property
    def contact_time(self) -> float:
        return float(np.diff(self.times, prepend=self.times[:1])[self.contact].sum())


@dataclass
class Hand:
    """Device and force loop, with their state.

    Attributes:
        path: force loop.
        state: operating state.
        surface, sample: newest surface and force sample; the next tick takes the sample.
        contact: contact of the last tick, None before the first.
        mode: recorded of the tool last; None before the first contact.
        ticks: time [ns], norm of the force [N], contact flag and force [N] of each tick.
        indexings: recorded changes of how the hand moves the tool, that are to come.
        indexing: the last one; None before the first.
        motion: stamp of the pose [ns], and the rest of a row of `Attempt.add_motion`, for each
            tick; None: nobody wants them.
    """

    path: ForcePath
    state: CrtkState = CrtkState.DISABLED
    surface: Surface | None = None
    sample: StampedMessage | None = None
    contact: StampedMessage | None = None
    mode: int | None = None
    ticks: list[tuple[int, float, bool, tuple[float, ...]]] = field(default_factory=list)
    indexings: deque[Indexing] = field(default_factory=deque)
    indexing: Indexing | None = None
    motion: list[tuple[int, list[float]]] | None = None

    def index(self, until: int) -> None:
        """Clutch, and change the scale of the motion, as before a device pose, by its stamp [ns].

        Before the first pose, the tool is where the session had it.
        """
        while self.indexings and self.indexings[0].after_ns < until:
            before, self.indexing = self.indexing, self.indexings.popleft()
            if before is None:
                continue  # it is that of the scene, which may be changed
            if not self.ticks:
                self.path.coupling.resume(self.indexing)
                continue
            if before.scale != self.indexing.scale:
                self.path.coupling.change(motion_scale=self.indexing.scale)
            self.path.coupling.change(clutched=self.indexing.clutched)

    def follow(self, record: FrameRecord) -> tuple[int, int]:
        """Change the tool as it was changed before a frame; return `times_of_frame`."""
        if record.contact is not None:
            if self.mode is not None and record.contact.mode != self.mode:
                self.path.next_mode = ToolMode(record.contact.mode)
            self.mode = record.contact.mode
        return times_of_frame(record)

    def move(self, coming: deque[StampedMessage], until: int) -> None:
        """Tick with each of the poses to come up to a stamp [ns]."""
        while coming and coming[0].stamp_ns <= until:
            self.tick(coming.popleft())

    def tick(self, pose: StampedMessage) -> None:
        now = pose.stamp_ns
        self.index(now)
        sample, self.sample = self.sample, None
        tick = self.path.tick(now, state=self.state, pose=pose, sample=sample, surface=self.surface)
        if tick.fault:
            raise SessionError(f'the haptic bridge comes to a FAULT: {tick.fault}')
        if self.state is CrtkState.DISABLED and self.path.is_fresh(now):
            self.state = CrtkState.ENABLED
        self.contact = StampedMessage(tick.contact_stamp_ns, '', tick.contact)
        if self.motion is not None and tick.contact_stamp_ns:  # 0: there was no device yet
            self.motion.append((tick.contact_stamp_ns, motion_of(self.contact.values)))
        force = tick.wrench[WrenchStampedCodec.fields['force']]
        self.ticks.append((now, self.path.force_norm, self.path.contact != NONE, force))


def run_experiment(bag: Bag, scene: Scene, computed: Resimulation) -> Run:
    """Compute a session from the poses of its device.

    Args:
        bag: bag of the session.
        scene: recorded scene, or a changed one.
        computed: simulation and cutting of that scene, before the first frame.

    Raises:
        SessionError: the bag has no poses, or the changed session ends in a FAULT.
    """
    return move_hand(*computable_poses(bag), recorded_indexings(bag), scene, computed)


def move_hand(
    records: Sequence[FrameRecord],
    poses: Sequence[StampedMessage],
    indexings: Sequence[Indexing],
    scene: Scene,
    computed: Resimulation,
    attempt: Attempt | None = None,
) -> Run:
    """Compute a session from frames, poses and indexings already read, as `run_experiment` does.

    Args:
        records, poses, indexings: as read.
        scene, computed: as of `run_experiment`.
        attempt: attempt at an exercise that is to see the session; None: there is none.

    Raises:
        SessionError: the changed session ends in a FAULT.
    """
    motion: list[tuple[int, list[float]]] | None = None if attempt is None else []
    hand = Hand(make_force_path(scene), indexings=deque(indexings), motion=motion)
    times_of_frames = (hand.follow(record) for record in records)
    computed.answer_frames = answer_frames(records)
    topology = -1
    for _ in closed_loop(poses, times_of_frames, hand, computed):
        mesh = computed.simulation.mesh
        if attempt is not None and mesh.topology != topology:
            topology = mesh.topology
            now = hand.ticks[-1][0] if hand.ticks else poses[0].stamp_ns
            attempt.see_tissue((now - poses[0].stamp_ns) * _NANOSECOND_S, mesh)
    times, forces, contact, vectors = map(np.array, zip(*hand.ticks, strict=True))
    run = _run(RecordedForce(times, forces, contact, vectors), computed)
    if attempt is not None and motion is not None:
        first = poses[0].stamp_ns
        rows = [((stamp - first) * _NANOSECOND_S, *row) for stamp, row in motion]
        add_samples(attempt, rows, list(zip(run.times, run.forces, strict=True)))
    return run


def recorded_run(bag: Bag, computed: Resimulation) -> tuple[Run, int | None]:
    """Return the recorded session: force and contact from the bag, the tissue recomputed.

    Args:
        bag: bag of the session.
        computed: simulation and cutting of its scene, before the first frame.

    Returns:
        The session, and the first frame whose force differs from the recorded one by more than
        rounding; None: there is none.

    Raises:
        BagError: a frame cannot be recomputed.
        SessionError: the bag has no poses, or no forces of the hand.
    """
    records, poses = computable_poses(bag)
    differs = recompute(records, computed)
    return as_felt(recorded_force(bag, poses), computed), differs


def recompute(records: Sequence[FrameRecord], computed: Resimulation) -> int | None:
    """Recompute the tissue under frames already read, as `recorded_run` does.

    Returns:
        The first frame whose force differs from the recorded one; None: there is none.

    Raises:
        BagError: a frame cannot be recomputed.
    """
    differs = None
    place = ForceSampleCodec.fields['force']
    for record, frame in zip(records, as_recorded(records, computed), strict=True):
        was = frame.force if record.force is None else np.array(record.force.values[place])
        off = float(np.abs(frame.force - was).max())
        if differs is None and off > MAX_ROUNDING * np.abs(was).max():
            differs = record.step
    return differs


def as_felt(felt: RecordedForce, computed: Resimulation) -> Run:
    """Return a recomputed session with the recorded force on the hand."""
    return _run(felt, computed)


def _run(felt: RecordedForce, computed: Resimulation) -> Run:
    return Run(
        times=(felt.times - felt.times[0]) * _NANOSECOND_S,
        forces=felt.forces,
        contact=felt.contact,
        vectors=felt.vectors,
        area=computed.area,
        elements_cut=computed.simulation.elements_cut,
        tetrahedra=len(computed.simulation.mesh.tetrahedra),
        substeps=computed.substeps,
        diverged=computed.diverged,
    )


def closed_loop(
    poses: Sequence[StampedMessage],
    times: Iterable[tuple[int, int]],
    hand: Hand,
    computed: Resimulation,
) -> Iterator[tuple[Frame, int]]:
    """Tick the force loop with each pose, and compute each frame at its time.

    Args:
        poses: poses of the device, in order.
        times: for each frame, stamps [ns] of the last poses before it, and before its answer.
        hand: hand before its first tick.
        computed: recomputation before its first frame.

    Yields:
        Each frame, and the result of the cut requested before it (see `FrameInputs.answer`).
    """
    coming = deque(poses)
    for begin, end in times:
        hand.move(coming, begin)
        answer = computed.answer()
        frame = computed.frame(_contact(computed, hand))
        seen = _seen(computed, hand, frame)
        hand.move(coming, end)
        hand.sample, hand.surface = seen
        yield frame, answer


def _contact(computed: Resimulation, hand: Hand) -> ToolContact | None:
    if hand.contact is None:
        return None
    return tool_contact(contact_message(hand.contact), computed.simulation.mesh)


def _seen(computed: Resimulation, hand: Hand, frame: Frame) -> tuple[StampedMessage, Surface]:
    """Return force sample and surface of a frame, as the force loop takes them."""
    simulation = computed.simulation
    sequence = 0 if hand.contact is None else int(hand.contact.values[0])
    stamp = 0 if hand.contact is None else hand.contact.stamp_ns
    head = (frame.step, frame.step, simulation.mesh.topology, sequence)
    values = (*head, *divmod(stamp, 1_000_000_000), *frame.felt)
    surface = Surface(
        simulation.positions,
        simulation.mesh.triangles,
        revision=frame.step,
        topology=simulation.mesh.topology,
        previous=hand.surface,
    )
    return StampedMessage(max(stamp, 1), '', values), surface
