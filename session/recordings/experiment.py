"""A recorded hand on another tissue: the way of the device as it was, all else computed afresh.

Proxy, tissue and cutting run together without ROS: every recorded pose is a tick of the force loop,
and the tissue has its frames at the poses where they were recorded. A cut is answered a frame
later. The hand does not yield to the force: it goes where it went.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from bags.frames import FrameRecord, contact_message, read_frames
from bags.reader import Bag
from bags.resimulation import Recomputation
from bags.topics import POSE, of_session
from haptic_bridge.chain import NONE
from haptic_bridge.force_path import ForcePath
from haptic_bridge.operating_state import State
from haptic_bridge.surface import Surface
from haptic_bridge.wire import PoseStampedCodec, Sample
from session.errors import SessionError
from session.scene import Scene
from tissue_sim.contact import Frame, ToolContact
from tissue_sim.tool_contact import tool_contact

_FRAME_NS = 33_333_333
_SECOND = 1e-9


@dataclass
class Run:
    """What one computation of a session came to.

    Attributes:
        times: of the ticks [s] since the first pose, shape (n,).
        forces: norm of the force on the hand [N], shape (n,).
        contact: whether something is touched, shape (n,).
        area: of the incision, one side, at rest [m^2].
        elements_cut: tetrahedra taken out by cuts.
        tetrahedra: at the end.
        substeps: of all frames.
        diverged: frames taken back.
    """

    times: np.ndarray
    forces: np.ndarray
    contact: np.ndarray
    area: float
    elements_cut: int
    tetrahedra: int
    substeps: int
    diverged: int

    def table(self, changed: 'Run', changes: Mapping[str, str]) -> Table:
        """This run beside one with changes."""
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
            ('frames taken back', 0, self.diverged, changed.diverged),
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
        """In SI units, for machines."""
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
    """Device, force loop and what they have come to so far.

    Attributes:
        path: the force loop.
        state: its operating state.
        surface, sample: of the tissue, newest; the sample until it was taken.
        contact: as the last tick had it, None before the first.
        ticks: time [ns], norm of the force [N], whether something is touched.
    """

    path: ForcePath
    state: State = State.DISABLED
    surface: Surface | None = None
    sample: Sample | None = None
    contact: Sample | None = None
    ticks: list[tuple[int, float, bool]] = field(default_factory=list)

    def tick(self, pose: Sample) -> None:
        now = pose.stamp_ns
        sample, self.sample = self.sample, None
        tick = self.path.tick(now, state=self.state, pose=pose, sample=sample, surface=self.surface)
        if tick.fault:
            raise SessionError(f'the haptic bridge comes to a FAULT: {tick.fault}')
        if self.state is State.DISABLED and self.path.is_fresh(now):
            self.state = State.ENABLED
        self.contact = Sample(tick.contact_stamp_ns, '', tick.contact)
        self.ticks.append((now, self.path.force_norm, self.path.contact != NONE))


def run_experiment(bag: Bag, scene: Scene, computed: Recomputation) -> Run:
    """Computes a session from the way of its device.

    Args:
        bag: of the session.
        scene: as recorded, or changed.
        computed: simulation and cutting of that scene, before the first frame.

    Raises:
        SessionError: the bag has no poses, or the changed session ends in a FAULT.
    """
    codec = PoseStampedCodec()
    topic = of_session(POSE, bag.topics())
    poses = [codec.decode(recorded.data) for recorded in bag.messages([topic])]
    if not poses:
        raise SessionError(f'{bag.path} has no message of {POSE}: there is no hand to follow')
    hand = Hand(ForcePath(scene.tool, scene.device, scene.haptics, scene.profile))
    substeps = diverged = 0
    untils = [time_of_contact(record) for record in read_frames(bag)]
    for frame, _ in closed_loop(poses, untils, hand, computed):
        substeps += frame.substeps
        diverged += frame.diverged
    computed.answer()
    times, forces, contact = (np.array(column) for column in zip(*hand.ticks, strict=True))
    return Run(
        times=(times - times[0]) * _SECOND,
        forces=forces,
        contact=contact,
        area=computed.area,
        elements_cut=computed.simulation.elements_cut,
        tetrahedra=len(computed.simulation.mesh.tetrahedra),
        substeps=substeps,
        diverged=diverged,
    )


def closed_loop(
    poses: Sequence[Sample], untils: Iterable[int], hand: Hand, computed: Recomputation
) -> Iterator[tuple[Frame, int]]:
    """Ticks the force loop with each pose, and computes a frame whenever its time has come.

    Args:
        poses: of the device, in order.
        untils: for each frame, stamp [ns] of the last pose before it.
        hand: at its beginning.
        computed: before its first frame.

    Yields:
        Each frame, and what came of the cut asked for before it (see `FrameInputs.answer`).
    """
    next_pose = 0
    for until in untils:
        while next_pose < len(poses) and poses[next_pose].stamp_ns <= until:
            hand.tick(poses[next_pose])
            next_pose += 1
        answer = computed.answer()
        frame = computed.frame(_contact(computed, hand))
        _show(computed, hand, frame)
        yield frame, answer


def time_of_contact(record: FrameRecord) -> int:
    """Stamp of the pose [ns] that a frame has seen last."""
    return record.pose.stamp_ns if record.pose is not None else record.time - _FRAME_NS


def _contact(computed: Recomputation, hand: Hand) -> ToolContact | None:
    if hand.contact is None:
        return None
    return tool_contact(contact_message(hand.contact), computed.simulation.mesh)


def _show(computed: Recomputation, hand: Hand, frame: Frame) -> None:
    """Gives the force loop what a frame came to."""
    simulation = computed.simulation
    sequence = 0 if hand.contact is None else int(hand.contact.values[0])
    stamp = 0 if hand.contact is None else hand.contact.stamp_ns
    head = (frame.step, frame.step, simulation.mesh.topology, sequence)
    vectors = (*frame.position, *frame.force, *frame.stiffness.ravel())
    energies = (frame.resistance, frame.kinetic_energy, frame.elastic_energy)
    values = (*head, *divmod(stamp, 1_000_000_000), int(frame.state), *vectors, *energies)
    hand.sample = Sample(max(stamp, 1), '', values)
    hand.surface = Surface(
        simulation.positions,
        simulation.mesh.triangles,
        revision=frame.step,
        topology=simulation.mesh.topology,
        previous=hand.surface,
    )
