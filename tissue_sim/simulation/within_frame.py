"""The tool within a frame: its law is evaluated several times, with the tool on its way.

At 30 Hz a hand moves the blade by millimetres in a frame. Evaluated once, the blade would go in
late, cut late, and hold on to tissue that it has left.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cutting_trainer.tissue_sim.contact.blade import Blade, Resistance
from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.contact.tool import ToolContact, ToolMode
from cutting_trainer.tissue_sim.mesh.locate import NearElements
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT

_PERIOD_S = 5.6e-3
"""[s] Longest time between two evaluations: six in a frame of 30 Hz."""


class Dent(NamedTuple):
    """What the tool has done to the surface since it touched it.

    Attributes:
        force: of the tool [N].
        tip: place of the tool's tip [m], shape (3,).
        stretch: of the coupling [m].
        depth: from where it touched [m].
        work: on the tissue [J].
    """

    force: float = 0.0
    tip: np.ndarray = np.zeros(3)
    stretch: float = 0.0
    depth: float = 0.0
    work: float = 0.0

    def deepened(
        self, force: float, tip: np.ndarray, normal: np.ndarray, stiffness: float
    ) -> 'Dent':
        """Return the dent at another force [N] and place of the tip [m].

        Args:
            force: of the tool [N].
            tip: place of its tip [m], shape (3,).
            normal: of the surface, outward, shape (3,).
            stiffness: of the coupling [N/m].
        """
        stretch = force / stiffness
        if force <= 0.0 or self.force <= 0.0:
            return Dent(force, tip, stretch)
        way = float((self.tip - tip) @ normal) - (stretch - self.stretch)
        work = self.work + (force + self.force) / 2 * way
        return Dent(force, tip, stretch, self.depth + way, work)


class ToolInFrame:
    """The tool from the begin to the end of one frame.

    Args:
        mesh: the tissue, which does not change its connectivity within a frame.
        resistance: of the tissue.
        contact: at the end of the frame.
        before: root and tip of the device's edge at its begin [m], shape (2, 3).
        pushing: the spring against the surface; free: none.
        blade: in the tissue; None: it is outside.
        positions: nodes at the begin of the frame [m], shape (n, 3).
        frame_time: [s].
        line_compliance: of the tissue, see `Material.line_compliance` [m^2/N].
        dent: of the tool on the surface at the begin of the frame.
        may_enter: whether the blade may go in now.

    Attributes:
        dent: at present.
        blade: at present; None: outside.
        coupling: the spring at present.
        parts: of the frame, in each of which there is one spring.
    """

    def __init__(
        self,
        mesh: TetMesh,
        resistance: Resistance,
        contact: ToolContact,
        before: np.ndarray,
        pushing: Coupling,
        blade: Blade | None,
        positions: np.ndarray,
        frame_time: float,
        line_compliance: float,
        dent: Dent,
        may_enter: Callable[[], bool],
    ) -> None:
        self._may_enter = may_enter
        self._mesh, self._resistance, self._contact = mesh, resistance, contact
        self._way = before, np.array([contact.blade_root, contact.blade_tip])
        self._pushing = pushing
        self._line_compliance = line_compliance
        self._first_dent = self.dent = dent
        self._near = NearElements(mesh.tetrahedra)
        self._opened = mesh.triangles[mesh.triangle_kind == CUT]
        self._positions = positions
        if blade is not None:
            blade.tie(mesh, self._near, positions)
        self._kept = None if blade is None else (blade, blade.kept())
        self.parts = max(int(np.ceil(frame_time / _PERIOD_S - 1e-9)), 1)
        self.blade = blade
        self.coupling = pushing

    def restart(self) -> Coupling:
        """Return to the begin of the frame, and the spring of its first part."""
        self.blade, self.coupling, self.dent = None, self._pushing, self._first_dent
        if self._kept is not None:
            self.blade, kept = self._kept
            self.blade.restore(kept)
            self._follow(0.0, self._positions)
        return self.coupling

    def after(self, share: float, positions: np.ndarray) -> Coupling:
        """Return the spring of the next part.

        Args:
            share: of the frame that has passed.
            positions: nodes now [m], shape (n, 3).
        """
        if self.blade is None and self._punctures(share, positions):
            hint = int(self._mesh.star(int(self._contact.nodes[0]))[0])
            root, tip = self._device(share)
            self.blade = Blade(self._resistance, root, tip, hint, self._line_compliance)
        if self.blade is not None:
            self.blade.carry(positions)
            self._follow(share, positions)
        return self.coupling

    def _punctures(self, share: float, positions: np.ndarray) -> bool:
        """Return whether the tool presses harder on the surface than it bears."""
        spring = self._pushing
        if spring.mode != PUSH:
            return False
        pressed = float(np.linalg.norm(spring.force(positions, share)))
        if self._resistance.tip_width > 0.0:
            tip, stiffness = self._device(share)[1], self._contact.stiffness
            self.dent = self.dent.deepened(pressed, tip, spring.normal, stiffness)
        if self._contact.mode != ToolMode.SCALPEL or not self._may_enter():
            return False
        at_tip = self._toughness() * self._resistance.tip_width
        if at_tip == 0.0:
            return pressed >= self._resistance.threshold
        return self.dent.work >= at_tip * self.dent.depth > 0.0

    def _toughness(self) -> float:
        """Return the toughness of the region that the tool touches [J/m^2]."""
        regions, resistance = self._mesh.regions, self._resistance
        number = (
            int(regions[self._mesh.star(int(self._contact.nodes[0]))[0]]) if len(regions) else 0
        )
        return resistance.regions[number - 1][0] if number else resistance.toughness

    def _follow(self, share: float, positions: np.ndarray) -> None:
        assert self.blade is not None
        stiffness, facing = self._contact.stiffness, self._contact.blade_facing
        device, moved = self._device(share), (self._way[1] - self._way[0]) / self.parts
        self.blade.follow(
            self._mesh, self._near, self._opened, positions, device, moved, stiffness, facing
        )
        self.coupling = self.blade.spring(positions, self._way[1], share, stiffness)

    def _device(self, share: float) -> np.ndarray:
        """Return root and tip of the device's edge [m], shape (2, 3)."""
        return np.asarray((1 - share) * self._way[0] + share * self._way[1])
