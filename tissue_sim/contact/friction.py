"""Dry friction between tool and tissue: its coefficients, and the tissue's side of it.

The haptic bridge owns the point to which the tool sticks, since it decides at 1 kHz between stick
and slip. The tissue gets the same point as the touched one, and the tool's end of the coupling
spring beside it. The spring pulls along the surface too, up to the friction cone.
"""

from typing import NamedTuple

import numpy as np

from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.contact.tool import ToolContact
from cutting_trainer.tissue_sim.contact.tool_spring import ContactName, ToolSprings
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

_ON_THE_CONE = 1e-9
"""Share of the coefficient by which a sliding tool's force may be off the cone: rounding."""


class Friction(NamedTuple):
    """Coefficients of dry friction.

    Attributes:
        sliding: tangential over normal force of a tool that slides; 0: none.
        ratio: static over sliding friction, 1 or more.
    """

    sliding: float = 0.0
    ratio: float = 1.0

    @property
    def static(self) -> float:
        """Tangential over normal force up to which the tool sticks."""
        return self.sliding * self.ratio


NO_FRICTION = Friction()


class GrippingSprings(ToolSprings):
    """Makes the springs of contacts with friction.

    Args:
        mesh, modulus, contact: see `ToolSprings`.
        friction: of tool and tissue.
    """

    def __init__(
        self, mesh: TetMesh, modulus: float, contact: ContactName, friction: Friction
    ) -> None:
        super().__init__(mesh, modulus, contact)
        self._mesh = mesh
        self._friction = friction
        self._stretch = np.zeros(3)

    def drag(self, coupling: Coupling, contact: ToolContact, point: np.ndarray) -> None:
        """Let the spring of a frame pull along the surface.

        It starts with the stretch that the last frame ended with, so that the force does not jump
        where the touched point moves on. Where the bridge's tool slides, the spring is stretched
        beyond the cone, so that the force is that of the cone however soft the tissue is.

        Args:
            coupling: spring along the normal; `start`, `end` and `share` change.
            contact: of the tool.
            point: tissue's end of the spring [m], shape (3,).
        """
        n, rest = coupling.normal, self._mesh.rest
        # The mean of the nodes is beside the touched point where the mesh is irregular.
        beside = coupling.weights @ rest[coupling.nodes] - contact.weights @ rest[contact.nodes]
        pull = _across(contact.device - contact.offset + beside - point, n)
        pressed = -float(contact.external @ n)
        side = _across(contact.external, n)
        cone = self._friction.sliding * pressed
        coupling.share = self._friction.static
        if abs(float(np.linalg.norm(side)) - cone) <= _ON_THE_CONE * cone:
            coupling.share = self._friction.sliding
            pull = pull + side / coupling.stiffness
        coupling.start = coupling.start + _across(self._stretch, n)
        coupling.end = coupling.end + pull

    def end_frame(self, coupling: Coupling, moved: np.ndarray, pressed: float) -> None:
        """Keep the stretch along the surface for the next frame.

        Args:
            coupling: spring of the frame.
            moved: displacement of the nodes at its end [m], shape (n, 3).
            pressed: normal force at its end [N].
        """
        self._stretch = np.zeros(3)
        if coupling.mode == PUSH:
            nodes, weights = coupling.nodes, coupling.weights
            point = weights @ (self._mesh.rest[nodes] + moved[nodes])
            stretch = _across(coupling.end - point, coupling.normal)
            most = coupling.share * pressed / coupling.stiffness
            size = float(np.linalg.norm(stretch))
            self._stretch = stretch * (most / size) if size > most else stretch


def _across(vector: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the part of a vector square to a unit normal; shapes (3,)."""
    return np.asarray(vector - (vector @ normal) * normal)
