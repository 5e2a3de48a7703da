"""A tool as the tissue knows it from frame to frame: its spring, its dent, its blade."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import Blade, Resistance
from cutting_trainer.tissue_sim.contact.coupling import FREE, HOLD, PUSH, Coupling
from cutting_trainer.tissue_sim.contact.friction import Friction, GrippingSprings
from cutting_trainer.tissue_sim.contact.tool import (
    MAX_PULL_N,
    MAX_STRETCH_RADII,
    ContactState,
    ToolContact,
    ToolMode,
)
from cutting_trainer.tissue_sim.contact.tool_spring import (
    ContactName,
    ToolSprings,
    footprint_force,
)
from cutting_trainer.tissue_sim.mesh.locate import distance_to_triangles, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta, Touched
from cutting_trainer.tissue_sim.motion.divergence import MAX_TOOL_SPEED
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.frame_motion import FrameMotion
from cutting_trainer.tissue_sim.simulation.local_stiffness import (
    ContactStiffness,
    GrippingStiffness,
)
from cutting_trainer.tissue_sim.simulation.within_frame import Dent, ToolInFrame


class Grip(NamedTuple):
    """Tissue between the jaws of a grasper.

    Attributes:
        nodes, weights: of the tissue between the jaws, shape (c,).
        offset: from that tissue to the tool, where the spring between them is relaxed [m], shape
            (3,).
        end: tool's end of the spring at the end of the last frame [m], shape (3,).
        normal: of the surface where the jaws closed, outward, shape (3,).
    """

    nodes: np.ndarray
    weights: np.ndarray
    offset: np.ndarray
    end: np.ndarray
    normal: np.ndarray


class ToolState:
    """State of one tool between frames.

    Args:
        dynamics: of the tissue.
        resistance: of the tissue against a blade.
        contact: how the load of the tool is spread, see `ToolSprings`.
        friction: of the tool on the surface.

    Attributes:
        state: of its contact.
        blade: of the tool in the tissue; None: it is outside.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        resistance: Resistance,
        contact: ContactName,
        friction: Friction,
    ) -> None:
        self._dynamics = dynamics
        self._resistance = resistance
        mesh, modulus = dynamics.mesh, dynamics.material.plane_modulus
        self._springs = ToolSprings(mesh, modulus, contact)
        told = ContactStiffness
        if friction.sliding > 0.0:
            self._springs = GrippingSprings(mesh, modulus, contact, friction)
            told = GrippingStiffness
        self._stiffness = told(dynamics, self._springs)
        self.state = ContactState.NONE
        self.blade: Blade | None = None
        self._pressed = 0.0
        self._dent = Dent()
        self._grip: Grip | None = None
        self._mode = ToolMode.SCALPEL
        self._target: np.ndarray | None = None
        self._device: np.ndarray | None = None
        self._edge: np.ndarray | None = None
        self._moved = np.zeros(3)

    def jump(self, contact: ToolContact | None) -> str:
        """Return why a contact is implausible after the last one, or ''."""
        before = self._device
        self._device = None if contact is None else contact.device.copy()
        self._moved = np.zeros(3)
        if before is None or contact is None:
            return ''
        self._moved = contact.device - before
        frame_time = 1.0 / self._dynamics.stepping.rate
        speed = float(np.linalg.norm(self._moved)) / frame_time
        if speed <= MAX_TOOL_SPEED:
            return ''
        return (
            f'the tool has moved by {1e3 * speed * frame_time:.3g} mm within a frame: '
            f'{speed:.3g} m/s are above the {MAX_TOOL_SPEED:g} m/s of a hand'
        )

    def begin(
        self, contact: ToolContact | None, may_enter: Callable[[], bool]
    ) -> ToolInFrame | None:
        """Return the tool of a frame; None: it does not act on the tissue.

        Args:
            contact: at the end of the frame; None: nothing is known of the tool.
            may_enter: whether its blade may go in now.
        """
        edge, self._edge = self._edge, None
        if contact is None:
            self._target = self._grip = None
            if self.blade is not None:
                self.blade.let_go()
            return None
        self._edge = np.array([contact.blade_root, contact.blade_tip])
        dynamics, pushing = self._dynamics, Coupling()
        positions, mesh = dynamics.positions, dynamics.mesh
        if self.blade is not None:
            edge = self.blade.device
        elif self._grips(contact, positions):
            pushing = self._held_by(contact)
        elif contact.state == ContactState.TOUCHING and contact.topology == mesh.topology:
            pushing = self._pushed_by(contact, positions)
            self._target = contact.device - contact.offset
        else:
            self._target = None
            return None
        return ToolInFrame(
            mesh,
            self._resistance,
            contact,
            self._edge if edge is None else edge,
            pushing,
            self.blade,
            positions,
            1.0 / dynamics.stepping.rate,
            dynamics.material.line_compliance,
            self._dent if pushing.mode == PUSH else Dent(),
            may_enter,
        )

    def end(
        self, contact: ToolContact | None, tool: ToolInFrame | None, *, jumped: bool
    ) -> Coupling:
        """Take over the result of a frame; return the spring of the tool at its end.

        Args:
            contact: at the end of the frame.
            tool: of `begin`.
            jumped: whether the contact was implausible.
        """
        coupling = Coupling()
        if tool is not None:
            self.blade, coupling, self._dent = tool.blade, tool.coupling, tool.dent
        elif contact is None or jumped or contact.state != ContactState.TOUCHING:
            self._dent = Dent()
        pressed = self._push_of(coupling)
        self._pressed = footprint_force(self._pressed, pressed)
        self._springs.end_frame(coupling, self._dynamics.displacement, pressed)
        return coupling

    def update(self, contact: ToolContact | None, coupling: Coupling) -> Blade | None:
        """Update the state of the contact; return the blade that has just left, or None.

        Args:
            contact: at the end of the frame.
            coupling: spring at the end of the frame.
        """
        if self.blade is None:
            touching = coupling.mode == PUSH
            self.state = ContactState.TOUCHING if touching else ContactState.NONE
            if contact is not None:
                self._close(contact, coupling)
            if self._grip is not None:
                self.state = ContactState.INSIDE
            return None
        self.state = ContactState.INSIDE
        if contact is None or not (contact.state == ContactState.NONE or self._clear(contact)):
            return None
        return self.release()

    def release(self) -> Blade | None:
        """Take the tool out of the tissue; return its blade, if that was in it."""
        blade, self.blade, self._grip = self.blade, None, None
        self._target = None
        self.state = ContactState.NONE
        return blade

    def reaction(self, motion: FrameMotion, coupling: Coupling, *, alone: bool) -> np.ndarray:
        """Return the force of the tissue on the tool [N], shape (3,).

        Args:
            motion: of the frame.
            coupling: spring at the end of it.
            alone: whether no other tool loads the same nodes.
        """
        if self.blade is not None:
            return -self.blade.force
        if coupling.mode == FREE:
            return np.zeros(3)
        dynamics = self._dynamics
        if not alone or self._grip is not None:
            return -coupling.force(dynamics.positions)
        internal = motion.elastic_force[coupling.nodes]
        beta = dynamics.material.beta
        if beta:
            viscous = dynamics.model.product(dynamics.velocity, coupling.nodes)
            internal = internal + beta * viscous
        return np.asarray(-internal.sum(axis=0))

    @property
    def transmits(self) -> float:
        """Largest force that the blade or the jaws transmit [N]."""
        if self.blade is not None:
            return self.blade.limit
        return MAX_PULL_N if self._grip is not None else 0.0

    def stiffness(
        self, contact: ToolContact | None, coupling: Coupling, force: np.ndarray
    ) -> np.ndarray:
        """Return - d force / d position [N/m], shape (3, 3).

        Args:
            coupling: spring at the end of the frame.
            contact: of the frame.
            force: on the tool [N], shape (3,).
        """
        outside = contact if self.blade is None else None
        stiffness = self._stiffness.matrix(coupling, outside, self._moved, force)
        if self.blade is not None:
            self.blade.note_stiffness(stiffness)
        return stiffness

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Follow a change of connectivity; arguments as of `ToolSprings.apply_cut`."""
        self._springs.apply_cut(count, delta, touched)
        if self.blade is not None:
            self.blade.untie()
        if self._grip is not None:
            nodes = self._grip.nodes.copy()
            for target, source in touched.renumbered:
                nodes[nodes == target] = -1  # it is gone
                nodes[nodes == source] = target
            left = self._dynamics.mesh.node_count
            lost = bool(((nodes < 0) | (nodes >= left)).any())
            self._grip = None if lost else self._grip._replace(nodes=nodes)

    def _pushed_by(self, contact: ToolContact, positions: np.ndarray) -> Coupling:
        """Return the spring of a contact.

        Along the surface it starts relaxed: the tissue sticks to the tool within a frame and slips
        between frames, unless there is friction (`GrippingSprings.drag`).
        """
        end, n = contact.device - contact.offset, contact.normal
        start = self._target
        if start is None:
            start = contact.weights @ positions[contact.nodes]
        coupling = self._springs.spring(contact, self._pressed, float((start - end) @ n))
        point = coupling.point(positions)
        start = point if self._target is None else start + (coupling.end - end)
        coupling.start = point + n * float((start - point) @ n)
        coupling.end = point + n * float((coupling.end - point) @ n)
        self._springs.drag(coupling, contact, point)
        return coupling

    def _grips(self, contact: ToolContact, positions: np.ndarray) -> bool:
        """Return whether the jaws still hold tissue."""
        grip = self._grip
        if grip is not None:
            pull = grip.end - grip.weights @ positions[grip.nodes]
            pull = pull - min(float(pull @ grip.normal), 0.0) * grip.normal  # not what is pressed
            most = min(MAX_PULL_N / contact.stiffness, MAX_STRETCH_RADII * contact.radius)
            if np.linalg.norm(pull) >= most or contact.mode != ToolMode.CLOSED_GRASPER:
                self._grip = None
        return self._grip is not None

    def _close(self, contact: ToolContact, spring: Coupling) -> None:
        """Grasp the tissue that jaws touch as they close; the spring keeps its force."""
        closes = contact.mode == ToolMode.CLOSED_GRASPER and self._mode != contact.mode
        self._mode = contact.mode
        if closes and spring.mode == PUSH:
            positions = self._dynamics.positions
            point = spring.point(positions)
            end = point + spring.force(positions) / spring.stiffness
            offset = contact.device - end
            self._grip = Grip(spring.nodes, spring.weights, offset, end, spring.normal)
            self._target = None

    def _held_by(self, contact: ToolContact) -> Coupling:
        """Return the spring to the tissue between the jaws."""
        assert self._grip is not None
        grip, end = self._grip, contact.device - self._grip.offset
        self._grip = grip._replace(end=end)
        held = grip.nodes, grip.weights, grip.end, end
        return Coupling(HOLD, *held, stiffness=contact.stiffness, limit=MAX_PULL_N)

    def _push_of(self, coupling: Coupling) -> float:
        """Return the normal force of the tool on the surface [N]."""
        if coupling.mode != PUSH:
            return 0.0
        return max(-float(coupling.force(self._dynamics.positions) @ coupling.normal), 0.0)

    def _clear(self, contact: ToolContact) -> bool:
        """Return whether the blade has left and the tip's sphere touches nothing, so that no force
        jumps.
        """
        if self.blade is None or self.blade.immersed > 0.0:
            return False
        positions, mesh = self._dynamics.positions, self._dynamics.mesh
        if distance_to_triangles(contact.device, positions, mesh.triangles) <= contact.radius:
            return False
        tip = contact.device[None]
        found, _ = find_tetrahedra(positions, mesh.tetrahedra, mesh.neighbors, tip)
        return bool(found[0] < 0)
