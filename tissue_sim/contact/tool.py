"""Data exchanged between the simulation, the haptic bridge and the cutting service."""

import enum
from dataclasses import dataclass, field

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import NOT_TURNED, Sweep, Turning
from cutting_trainer.tissue_sim.mesh.strain import Strain
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

MAX_PULL_N = 5.0
"""[N] at which tissue slips out of the jaws of a grasper."""
MAX_STRETCH_RADII = 2.0
"""Radii of the tool between jaws and tissue at which it slips, too."""
MIN_RADIUS_M = 1e-5
"""[m] Least radius of a tool: a point would have no footprint and an infinite pressure."""


class ContactState(enum.IntEnum):
    """State of the contact between tool and tissue; numbers as in the `Contact` message."""

    NONE = 0
    TOUCHING = 1
    INSIDE = 2


class ToolMode(enum.IntEnum):
    """Kind of a tool; numbers as in `Contact`.

    A palpator never goes in. A grasper holds the tissue that its jaws close on, until they open.
    """

    SCALPEL = 0
    PALPATOR = 1
    OPEN_GRASPER = 2
    CLOSED_GRASPER = 3

    @property
    def is_grasper(self) -> bool:
        """Whether it has jaws."""
        return self in (ToolMode.OPEN_GRASPER, ToolMode.CLOSED_GRASPER)

    @property
    def other(self) -> 'ToolMode':
        """The mode that a press of the mode button changes to."""
        return ToolMode(self ^ 1)

    def with_jaws(self, *, closed: bool) -> 'ToolMode':
        """Return the mode with jaws closed or open: a grasper's, or that of scissors.

        Closed scissors are a scalpel, open ones a palpator.
        """
        if self.is_grasper:
            return ToolMode.CLOSED_GRASPER if closed else ToolMode.OPEN_GRASPER
        return ToolMode.SCALPEL if closed else ToolMode.PALPATOR


class CutCommand(enum.IntEnum):
    """Command to the cutting service; numbers as in `Cut`."""

    ADVANCE = 0
    FINISH = 1


class CutOutcome(enum.IntEnum):
    """Outcome of a cut; numbers as in `FrameInputs.answer`.

    After REFUSED, the sweep stays uncut. A LOST cut is requested again. GIVEN_UP is a FINISH for a
    stroke that no service remembers.
    """

    NO_ANSWER = 0
    APPLIED = 1
    EMPTY = 2
    REFUSED = 3
    LOST = 4
    GIVEN_UP = 5


@dataclass(frozen=True)
class ToolContact:
    """Contact as reported by the haptic bridge, see `Contact.msg`; tissue frame, [m].

    Attributes:
        nodes, weights: that share the load, each once, shape (c,). Where nothing is touched: those
            of the point that a touch would meet first, or none.
        offset: from the touched point to the proxy's centre [m], shape (3,).
        external: force of the tool on the tissue as the bridge has it [N], shape (3,); the
            simulation takes from it whether the tool slides.
        mode: kind of the tool. A blade that is in the tissue stays there.
        blade_facing: unit vector across the blade, from its spine to its edge; zero: it cuts all
            round, shape (3,).
    """

    state: ContactState
    topology: int
    nodes: np.ndarray
    weights: np.ndarray
    device: np.ndarray
    offset: np.ndarray
    normal: np.ndarray
    stiffness: float
    radius: float
    blade_root: np.ndarray
    blade_tip: np.ndarray
    sequence: int = 0
    external: np.ndarray = field(default_factory=lambda: np.zeros(3))
    mode: ToolMode = ToolMode.SCALPEL
    blade_facing: np.ndarray = field(default_factory=lambda: np.zeros(3))


def indenter_contact(
    mesh: TetMesh, place: np.ndarray, direction: np.ndarray, depth: float, stiffness: float = 200.0
) -> ToolContact:
    """Return the contact of an indenter on one triangle of the tissue at rest, for measuring
    frames.

    Args:
        mesh: the tissue.
        place: the triangle with the nearest centre is pressed [m], shape (3,).
        direction: of indentation, a unit vector, shape (3,).
        depth: of the tip below the triangle [m].
        stiffness: of the coupling spring [N/m].
    """
    middles = mesh.rest[mesh.triangles].mean(axis=1)
    nearest = int(np.linalg.norm(middles - place, axis=1).argmin())
    nodes = mesh.triangles[nearest].astype(np.int64)
    device = mesh.rest[nodes].mean(axis=0) + depth * direction
    return ToolContact(
        state=ContactState.TOUCHING,
        topology=mesh.topology,
        nodes=nodes,
        weights=np.full(3, 1 / 3),
        device=device,
        offset=np.zeros(3),
        normal=-direction,
        stiffness=stiffness,
        radius=0.004,
        blade_root=device - 0.02 * direction,
        blade_tip=device,
    )


@dataclass(frozen=True)
class Frame:
    """Result of one frame, see `ForceSample.msg`.

    Attributes:
        step: number of the frame, from 1.
        state: state of the contact.
        position: tool tip at which the force acts [m], shape (3,).
        force: of the tissue on the tool [N], shape (3,).
        stiffness: - d force / d position [N/m], shape (3, 3).
        resistance: largest force that the blade transmits [N].
        turning: torque of the blade; zero outside of the tissue.
        kinetic_energy, elastic_energy: [J].
        substeps: number of substeps.
        slow_motion: simulated time over frame time, 1 unless the substeps were too few.
        command: to the cutting service, or None.
        sweep: the blade's sweep with an ADVANCE.
        diverged: the frame diverged and was rolled back, see `divergence`.
        trouble: the error with its limit and cause; empty: none. Without `diverged`, shorter steps
            corrected it, or the tool was released.
        strain: of a model with a law, else None.
        tool: number of the tool that feels it.
        others: the same frame, as the other tools feel it, in order.
        concession: steps by which fewer nodes moved on their own, see `FarField.concede`.
    """

    step: int
    state: ContactState
    position: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    resistance: float
    kinetic_energy: float
    elastic_energy: float
    substeps: int
    slow_motion: float
    command: CutCommand | None = None
    sweep: Sweep | None = None
    diverged: bool = False
    trouble: str = ''
    strain: Strain | None = None
    turning: Turning = NOT_TURNED
    tool: int = 0
    others: tuple['Frame', ...] = ()
    concession: int = 0

    @property
    def by_tool(self) -> tuple['Frame', ...]:
        """The frame as each tool feels it."""
        return (self, *self.others)

    @property
    def felt(self) -> tuple[float, ...]:
        """What a tool feels: the values of a `ForceSample` from `state` on."""
        vectors = np.concatenate([self.position, self.force, self.stiffness.ravel()])
        scalars = (self.resistance, self.kinetic_energy, self.elastic_energy, self.tool)
        torque, most, immersed = self.turning
        return (
            int(self.state), *vectors.tolist(), *scalars, *torque.tolist(), most, *immersed.tolist()
        )  # fmt: skip
