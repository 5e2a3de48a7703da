"""Stiffness of the tissue under the tool, and its gradient along the tool's path."""

import math
from dataclasses import replace

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import FREE, HOLD, PUSH, Coupling
from cutting_trainer.tissue_sim.contact.tool import ContactState, ToolContact
from cutting_trainer.tissue_sim.contact.tool_spring import ToolSprings
from cutting_trainer.tissue_sim.elasticity.compliance import PointCompliance
from cutting_trainer.tissue_sim.mesh.locate import closest_triangle
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics

_PREVIEW_DISTANCE, _PREVIEW_S = 0.01, 0.25
"""[m] and [s]: a free tool gets the stiffness ahead from this distance on, or so long before
contact: a frame, its computing, and 0.1 s of delay each way."""
_FIRST_FRAMES = 10
"""Frames in which it gets it at any distance; then a rough estimate of the stiffness exists."""
_LOOKAHEAD, _MIN_LOOKAHEAD = 1.2, 1e-3
"""Distance at which the stiffness ahead is sampled: paths of the last frame [-], one and the
computing time; and at least so far [m]."""
_MIN_PATH = 5e-5
"""[m] along the surface in a frame below which a tool does not move."""
_MIN_CHANGE, _FIRST_DEPTH = 2e-4, 1e-3
"""Smallest change of the depth for which the stiffness is told, and the one for a first touch [m]:
under a sphere it is zero at first, and grows."""
_MAX_SLOPE = 4.0
"""Largest slope of the force along the surface, in stiffnesses of the coupling spring. It is 0.3 at
most under sliding hands. Beyond, F / k is no possible depth of the tool."""


class ContactStiffness:
    """Stiffness sent to the haptic bridge with the force, for the time until the next frame.

    It changes within a frame: with depth under a sphere, and along the surface where the tissue
    differs, above all where the touched triangle takes the load.

    Args:
        dynamics: of the tissue.
        springs: makes the springs of contacts.
    """

    def __init__(self, dynamics: Dynamics, springs: ToolSprings) -> None:
        self._dynamics = dynamics
        self._springs = springs
        self._here, self._ahead = PointCompliance(), PointCompliance()

    def matrix(
        self, coupling: Coupling, contact: ToolContact | None, moved: np.ndarray, force: np.ndarray
    ) -> np.ndarray:
        """Return the stiffness of tissue and coupling spring in series, - d force / d position
        [N/m], shape (3, 3).

        On the surface it is k n n^T - (F / k) n (grad k)^T, with the normal n and the normal force
        F. The gradient is known along the tool's path only. In the tissue, it includes all that
        resists the edge. Tissue in series is never stiffer than the coupling spring. The second
        term is limited to `_MAX_SLOPE` times the spring's stiffness, so that no forged contact can
        exceed it.

        A tool near the tissue gets the stiffness ahead: the first touch then feels as stiff as the
        rest, whatever the delay of the answer.

        Args:
            coupling: the spring of the frame.
            contact: of a tool outside the tissue; None without one.
            moved: displacement of the tool since the last frame [m], shape (3,).
            force: on the tool [N], shape (3,).
        """
        spring = coupling
        if spring.mode == FREE:
            if contact is None or not self._is_foreseen(contact, moved):
                return np.zeros((3, 3))
            ahead = max(-float(moved @ contact.normal), _FIRST_DEPTH)
            spring = self._springs.spring(contact, 0.0, ahead)
        axes = np.eye(3) if spring.mode == HOLD else spring.normal[None]
        soft = self._compliance(self._here, spring.nodes, spring.weights, axes)
        own = 1 / spring.stiffness
        if spring.hertz > 0.0:
            pressed = float(force @ spring.normal) if coupling.mode == PUSH else 0.0
            own = self._yielding(spring, float(soft[0, 0]), pressed, -float(moved @ spring.normal))
        matrix = axes.T @ np.linalg.inv(np.eye(len(axes)) * own + soft) @ axes
        if coupling.mode == PUSH:
            n, k = coupling.normal, float(np.trace(matrix))
            slope = float(force @ n) / k * self._gradient(coupling, own, k, moved)
            size, most = float(np.linalg.norm(slope)), _MAX_SLOPE * coupling.stiffness
            matrix -= np.outer(n, slope * (most / size) if size > most else slope)
        return matrix if spring.mode == HOLD else self._gripped(matrix, spring)

    def _gripped(self, matrix: np.ndarray, spring: Coupling) -> np.ndarray:
        """Return the stiffness on the surface: without friction, there is none along it."""
        return matrix

    def _is_foreseen(self, contact: ToolContact, moved: np.ndarray) -> bool:
        """Return whether the tool may touch before the next message."""
        if (
            contact.state != ContactState.NONE
            or contact.topology != self._dynamics.mesh.topology
            or len(contact.nodes) == 0
            or contact.stiffness <= 0
        ):
            return False
        gap = float(np.linalg.norm(contact.offset)) - contact.radius
        speed = float(np.linalg.norm(moved)) * self._dynamics.stepping.rate
        return gap <= _PREVIEW_DISTANCE + _PREVIEW_S * speed or self._here.calls < _FIRST_FRAMES

    def _yielding(self, spring: Coupling, soft: float, pressed: float, change: float) -> float:
        """Return the compliance of a spring on a footprint, over the next change of depth [m/N].

        Args:
            spring: of the contact.
            soft: compliance of the mesh [m/N].
            pressed: normal force [N].
            change: how much deeper the tool has come in the last frame [m].
        """
        series = replace(spring, stiffness=1 / (1 / spring.stiffness + soft))
        if pressed <= 0.0:
            here, change = 0.0, max(change, _FIRST_DEPTH)
        else:
            here = series.stretch_at(pressed)
        there = max(here + (change if abs(change) > _MIN_CHANGE else _MIN_CHANGE), 0.0)
        gained = series.pushed(there) - series.pushed(here)
        softness = (there - here) / gained if gained else 0.0
        return float(max(softness, 1 / series.stiffness) - soft)

    def _gradient(
        self, coupling: Coupling, own: float, here: float, moved: np.ndarray
    ) -> np.ndarray:
        """Return the gradient of the stiffness along the tool's path [N/m^2], shape (3,).

        Args:
            coupling: the spring of the frame.
            own: its compliance [m/N].
            here: stiffness of tissue and spring [N/m].
            moved: displacement of the tool since the last frame [m], shape (3,).
        """
        n = coupling.normal
        way = moved - (moved @ n) * n
        length = float(np.linalg.norm(way))
        if length < _MIN_PATH:
            return np.zeros(3)
        look = max(_LOOKAHEAD * length, _MIN_LOOKAHEAD)
        mesh = self._dynamics.mesh
        # At rest: the walls of the tool's own indentation do not resist it.
        start = coupling.weights @ mesh.rest[coupling.nodes]
        touched = _closest(mesh, start + way * (look / length))
        ahead = self._springs.moved(coupling, *touched)
        soft = self._compliance(self._ahead, ahead.nodes, ahead.weights, n[None])[0, 0]
        there = 1.0 / (own + coupling.seen - ahead.seen + soft)
        return way * ((there - here) / (look * length))

    def _compliance(
        self, point: PointCompliance, nodes: np.ndarray, weights: np.ndarray, axes: np.ndarray
    ) -> np.ndarray:
        d = self._dynamics
        return point.estimate(d.model, d.masses.inverse > 0, nodes, weights, axes)


class GrippingStiffness(ContactStiffness):
    """Stiffness of a contact with friction: to the one above, t (I - n n^T) is added.

    t is that of tissue and coupling spring along the surface, where the tool sticks; arguments as
    above.
    """

    def __init__(self, dynamics: Dynamics, springs: ToolSprings) -> None:
        super().__init__(dynamics, springs)
        self._beside = PointCompliance()

    def _gripped(self, matrix: np.ndarray, spring: Coupling) -> np.ndarray:
        n = spring.normal
        axes = _tangents(n)
        soft = self._compliance(self._beside, spring.nodes, spring.weights, axes)
        along = 1 / (1 / spring.stiffness + float(np.trace(soft)) / 2)
        return matrix + along * (np.eye(3) - np.outer(n, n))


def _tangents(n: np.ndarray) -> np.ndarray:
    """Return two unit vectors square to n and to each other, shape (2, 3).

    They turn with n without jumps, so that what was computed for them holds in the next frame
    (Duff et al. 2017).
    """
    x, y, z = n.tolist()
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])


def _closest(mesh: TetMesh, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of approximately the closest surface point at rest."""
    nodes = mesh.triangles[closest_triangle(point, mesh.rest, mesh.triangles)].astype(np.int64)
    arms = mesh.rest[nodes] - point
    normal = np.cross(arms[1] - arms[0], arms[2] - arms[0])
    parts = np.array([np.cross(arms[i - 2], arms[i - 1]) @ normal for i in range(3)])
    weights = np.maximum(parts, 0.0)
    return nodes, weights / weights.sum()
