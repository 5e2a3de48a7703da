"""How stiff the tissue is under the tool, and how that changes along the tool's way."""

import numpy as np

from tissue_sim.compliance import PointCompliance
from tissue_sim.contact import State, ToolContact
from tissue_sim.coupling import FREE, HOLD, PUSH, Coupling
from tissue_sim.dynamics import Dynamics
from tissue_sim.locate import closest_triangle
from tissue_sim.mesh import TetMesh

_NEAR, _FORESIGHT = 0.01, 0.25
"""[m] and [s]: a free tool is told what it would meet from this near on, or so long before it can
be there: a frame, its computing, and 0.1 s of delay each way."""
_FIRST_FRAMES = 10
"""In which it is told from anywhere: then the stiffness of the tissue is known roughly."""
_LOOK, _LEAST_LOOK = 1.2, 1e-3
"""How far ahead the tissue is asked: ways of the last frame [-], one and what computing takes; and
at least so far [m]."""
_LEAST_WAY = 5e-5
"""[m] along the surface in a frame below which a tool goes nowhere."""
_STEEPEST = 4.0
"""How steeply the force may change along the surface, in stiffnesses of the coupling spring: it
is 0.3 at most where hands slide. Beyond, F / k is no depth that the tool can have."""


class ContactStiffness:
    """What the tool is told beside the force, for the time until the next frame.

    A contact load sinks deeper at a node than between nodes, on a coarse mesh by up to a factor
    of three, and nodes differ: under a tool that slides the stiffness changes within a frame.

    Args:
        dynamics: of the tissue.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        self._dynamics = dynamics
        self._here, self._ahead = PointCompliance(), PointCompliance()

    def matrix(
        self, coupling: Coupling, contact: ToolContact | None, moved: np.ndarray, force: np.ndarray
    ) -> np.ndarray:
        """Of tissue and coupling spring in series, - d force / d position [N/m], shape (3, 3).

        On the surface k n n^T - (F / k) n (grad k)^T, n the normal and F the force along it; the
        gradient is known along the tool's way only. In the tissue, all that the edge meets. Tissue
        in series is never stiffer than the coupling spring, and the second part is held to
        `_STEEPEST` times its stiffness: a contact that nobody's hand makes cannot exceed it.

        A tool that comes near is told what it would meet: the first touch is then felt as stiff as
        the rest, however late the answer to it comes.

        Args:
            coupling: the spring of the frame.
            contact: of a tool that is not in the tissue; None: there is none.
            moved: way of the tool since the last frame [m], shape (3,).
            force: on the tool [N], shape (3,).
        """
        spring = coupling
        if spring.mode == FREE:
            if contact is None or not self._is_foreseen(contact, moved):
                return np.zeros((3, 3))
            spring = spring_of(contact)
        axes = np.eye(3) if spring.mode == HOLD else spring.normal[None]
        soft = self._compliance(self._here, spring.nodes, spring.weights, axes)
        matrix = axes.T @ np.linalg.inv(np.eye(len(axes)) / spring.stiffness + soft) @ axes
        if coupling.mode == PUSH:
            n, k = coupling.normal, float(np.trace(matrix))
            slope = float(force @ n) / k * self._gradient(coupling, k, moved)
            size, most = float(np.linalg.norm(slope)), _STEEPEST * coupling.stiffness
            matrix -= np.outer(n, slope * (most / size) if size > most else slope)
        return matrix

    def _is_foreseen(self, contact: ToolContact, moved: np.ndarray) -> bool:
        """Whether the tool may touch before it can be told more."""
        if (
            contact.state != State.NONE
            or contact.topology != self._dynamics.mesh.topology
            or len(contact.nodes) == 0
            or contact.stiffness <= 0
        ):
            return False
        gap = float(np.linalg.norm(contact.offset)) - contact.radius
        speed = float(np.linalg.norm(moved)) * self._dynamics.stepping.rate
        return gap <= _NEAR + _FORESIGHT * speed or self._here.calls < _FIRST_FRAMES

    def _gradient(self, coupling: Coupling, here: float, moved: np.ndarray) -> np.ndarray:
        """Of the stiffness, along the tool's way [N/m^2], shape (3,)."""
        n = coupling.normal
        way = moved - (moved @ n) * n
        length = float(np.linalg.norm(way))
        if length < _LEAST_WAY:
            return np.zeros(3)
        look = max(_LOOK * length, _LEAST_LOOK)
        mesh = self._dynamics.mesh
        # At rest: the tool's own dent has walls that it does not meet.
        start = coupling.weights @ mesh.rest[coupling.nodes]
        nodes, weights = _closest(mesh, start + way * (look / length))
        soft = self._compliance(self._ahead, nodes, weights, n[None])[0, 0]
        there = 1.0 / (1.0 / coupling.stiffness + soft)
        return way * ((there - here) / (look * length))

    def _compliance(
        self, point: PointCompliance, nodes: np.ndarray, weights: np.ndarray, axes: np.ndarray
    ) -> np.ndarray:
        """Of what is simulated: nodes that a budget holds do not yield to the hand either."""
        d = self._dynamics
        return point.estimate(d.model, d.inverse_mass > 0, nodes, weights, axes, d.held_to)


def spring_of(contact: ToolContact) -> Coupling:
    """The spring that pushes where the tool touches, or would; its start is still open."""
    return Coupling(
        mode=PUSH,
        nodes=contact.nodes,
        weights=contact.weights,
        end=contact.device - contact.offset,
        normal=contact.normal,
        stiffness=contact.stiffness,
    )


def _closest(mesh: TetMesh, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of about the point of the surface at rest that is closest to a point."""
    nodes = mesh.triangles[closest_triangle(point, mesh.rest, mesh.triangles)].astype(np.int64)
    arms = mesh.rest[nodes] - point
    normal = np.cross(arms[1] - arms[0], arms[2] - arms[0])
    parts = np.array([np.cross(arms[i - 2], arms[i - 1]) @ normal for i in range(3)])
    weights = np.maximum(parts, 0.0)
    return nodes, weights / weights.sum()
