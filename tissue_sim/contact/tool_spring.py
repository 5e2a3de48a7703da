"""The spring between tool and surface: nodes under load, and the law of its normal force."""

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.contact.footprint import SETTLEMENT, Footprints
from cutting_trainer.tissue_sim.contact.tool import ToolContact
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, Touched

ContactName = Literal['footprint', 'triangle']

SPHERE = 1 / 15
"""Growth of the settlement by depth over radius, relative to that under Hertz's paraboloid.

It is the first term of Sneddon's solution for a sphere (1965): with x = a / R, the settlement is
R x atanh(x), the force E* R^2 ((1 + x^2) atanh(x) - x).
"""


_HELD = 0.03
"""Change of the normal force within which the footprint keeps its size. Its radius goes with the
cube root, so that a disc of `WIDENING` is never too small for `SETTLEMENT`."""


def footprint_force(before: float, now: float) -> float:
    """Return the normal force that sizes the footprint of the next frame [N].

    The footprint is a frame late. If it followed each change, a tool at rest on a tissue with
    little damping would not come to rest.

    Args:
        before: the force that sized this frame's [N].
        now: at the end of this frame [N].
    """
    return before if abs(now - before) <= _HELD * before else now


class ToolSprings:
    """Makes the springs of contacts on the surface.

    Args:
        mesh: the tissue, not cut yet; followed by `apply_cut`.
        modulus: E / (1 - nu^2) [Pa].
        contact: footprint: the load goes to what the sphere touches; triangle: to the nodes of the
            touched triangles, so that the force depends on the size of the elements.
    """

    def __init__(self, mesh: TetMesh, modulus: float, contact: ContactName) -> None:
        self._modulus = modulus
        self._footprints = Footprints(mesh) if contact == 'footprint' else None

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Follow a change of connectivity; arguments as of `Footprints.apply_cut`."""
        if self._footprints is not None:
            self._footprints.apply_cut(count, delta, touched)

    def spring(self, contact: ToolContact, pressed: float, advance: float) -> Coupling:
        """Return the spring of a present or predicted touch; its start is not set yet.

        Args:
            contact: of the tool.
            pressed: normal force by `footprint_force` [N].
            advance: how far the tool goes on into the tissue in this frame [m].
        """
        coupling = Coupling(
            mode=PUSH,
            nodes=contact.nodes,
            weights=contact.weights,
            end=contact.device - contact.offset,
            normal=contact.normal,
            stiffness=contact.stiffness,
        )
        if self._footprints is None or contact.radius <= 0.0:
            return coupling
        radius, modulus = contact.radius, self._modulus
        coupling.hertz = (9 / (16 * modulus**2 * radius)) ** (1 / 3)
        coupling.bend = SPHERE * coupling.hertz / radius
        # A contact as wide as the tool grows no wider: the settlement is then a cylinder's.
        coupling.most = 4 / 3 * modulus * radius**2
        depth = coupling.hertz * np.cbrt(pressed) ** 2 + max(advance, 0.0)
        hertz = math.sqrt(radius * min(depth, radius))
        coupling.reach = self._footprints.radius(contact.nodes, contact.weights, hertz)
        self._spread(coupling)
        return coupling

    def moved(self, coupling: Coupling, nodes: np.ndarray, weights: np.ndarray) -> Coupling:
        """Return the same spring with the tool at another point of the surface.

        Args:
            coupling: made by `spring`.
            nodes, weights: of the touched point, shape (c,).
        """
        there = replace(coupling, nodes=nodes, weights=weights)
        if there.reach > 0.0:
            self._spread(there)
        return there

    def drag(self, coupling: Coupling, contact: ToolContact, point: np.ndarray) -> None:
        """Do nothing: without friction, the spring pulls along the normal (`GrippingSprings`)."""

    def end_frame(self, coupling: Coupling, moved: np.ndarray, pressed: float) -> None:
        """Do nothing: without friction, nothing is kept for the next frame."""

    def _spread(self, coupling: Coupling) -> None:
        """Give the load on a touched point to the nodes within `reach`."""
        assert self._footprints is not None
        found = self._footprints.around(coupling.nodes, coupling.weights, coupling.reach)
        coupling.nodes, coupling.weights = found.nodes, found.weights
        coupling.end = coupling.end + found.height * coupling.normal
        coupling.seen = SETTLEMENT / (self._modulus * found.radius) if found.radius > 0.0 else 0.0
