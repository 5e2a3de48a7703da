"""What the simulation is told of the tool, and what it answers."""

import enum
from dataclasses import dataclass

import numpy as np

from tissue_sim.blade import Sweep
from tissue_sim.mesh import TetMesh


class State(enum.IntEnum):
    """How the tool stands to the tissue; the numbers are those of the `Contact` message."""

    NONE = 0
    TOUCHING = 1
    INSIDE = 2


class Command(enum.IntEnum):
    """What the simulation asks of the cutting service; the numbers are those of `Cut`."""

    ADVANCE = 0
    FINISH = 1


@dataclass(frozen=True)
class ToolContact:
    """What the haptic bridge says about the tool, see `Contact.msg`; tissue frame, [m].

    Attributes:
        nodes, weights: that share the load, each once, shape (c,). Where nothing is touched: those
            of the point that a touch would meet first, or none.
        offset: from the touched point to the proxy's centre [m], shape (3,).
    """

    state: State
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


def press_triangle(
    mesh: TetMesh, place: np.ndarray, direction: np.ndarray, depth: float, stiffness: float = 200.0
) -> ToolContact:
    """A tool that presses straight on one triangle of the tissue at rest: to measure frames by.

    Args:
        mesh: the tissue.
        place: the triangle is the one whose middle is nearest [m], shape (3,).
        direction: of the press, a unit vector, shape (3,).
        depth: of the tip below the triangle [m].
        stiffness: of the coupling spring [N/m].
    """
    middles = mesh.rest[mesh.triangles].mean(axis=1)
    nearest = int(np.linalg.norm(middles - place, axis=1).argmin())
    nodes = mesh.triangles[nearest].astype(np.int64)
    device = mesh.rest[nodes].mean(axis=0) + depth * direction
    return ToolContact(
        state=State.TOUCHING,
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
    """What one frame came to, see `ForceSample.msg`.

    Attributes:
        step: number of the frame, from 1.
        state: how the tool stands to the tissue.
        position: tool tip that the force belongs to [m], shape (3,).
        force: of the tissue on the tool [N], shape (3,).
        stiffness: - d force / d position [N/m], shape (3, 3).
        resistance: largest force that the blade transmits [N].
        kinetic_energy, elastic_energy: [J].
        substeps: how many.
        slow_motion: simulated time over frame time, 1 unless the substeps did not suffice.
        command: what is asked of the cutting service, or None.
        sweep: the blade's sweep with an ADVANCE.
        diverged: the frame was not trusted and has been taken back, see `guard`.
        trouble: what went wrong, with the limit and the cause; empty: nothing. Without `diverged`
            it was mended by shorter steps, or the tool was let go.
    """

    step: int
    state: State
    position: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    resistance: float
    kinetic_energy: float
    elastic_energy: float
    substeps: int
    slow_motion: float
    command: Command | None = None
    sweep: Sweep | None = None
    diverged: bool = False
    trouble: str = ''
