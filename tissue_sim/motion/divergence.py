"""Divergence detector: energy without a source, nodes that leave, implausible tool motion."""

import numpy as np

from cutting_trainer.tissue_sim.mesh.checks import EDGES, components
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, tetrahedron_volumes

MAX_TOOL_SPEED = 3.0
"""[m/s] of a tool; hands reach 2."""
_FACTOR = 3.0
_MEMORY = 0.95
_SHARE = 0.1
_MIN_STRAIN = 1e-4


class DivergenceDetector:
    """Detects divergence by an energy balance of tissue energy and work of the tool.

    An unstable integrator creates energy long before a node leaves its place. Damping only removes
    energy, so the balance is the lesser of the previous energy plus the tool's work, and the
    present energy. A frame diverges if its energy exceeds three times the balance and a tenth of
    the recent energy. The slack covers the work, which is a sum over steps.

    Args:
        mesh: the tissue.
        youngs_modulus: [Pa].
    """

    def __init__(self, mesh: TetMesh, youngs_modulus: float) -> None:
        self._mesh = mesh
        self._size = float(np.linalg.norm(np.ptp(mesh.rest, axis=0)))
        self._floor = youngs_modulus * float(mesh.volumes().sum()) * _MIN_STRAIN**2
        self._account = 0.0
        self._peak = 0.0

    def open(self, energy: float) -> None:
        """Restart the balance at an energy [J], after a cut for example."""
        self._account = energy

    def has_left(self, u: np.ndarray) -> bool:
        """Return whether a node has moved farther than the tissue is long, or to no number.

        Args:
            u: displacement [m], shape (n, 3).
        """
        return not float(np.abs(u).max(initial=0.0)) < self._size  # true for NaN

    def diagnose(self, u: np.ndarray, energy: float, work: float) -> str:
        """Return why a frame diverges, as a sentence; '' if it does not, and the balance continues.

        Args:
            u: displacement [m], shape (n, 3).
            energy: kinetic and elastic [J].
            work: of the tool in this frame [J].
        """
        if self.has_left(u):
            farthest = float(np.abs(u).max())
            return (
                f'a node would have moved {farthest:.3g} m, farther than the tissue is long, '
                f'{self._size:.3g} m'
            )
        account = max(self._account + work, 0.0)
        limit = max(_FACTOR * account, _SHARE * max(self._peak, account), self._floor)
        if not energy <= limit:
            return (
                f'the tissue has an energy of {energy:.3g} J, the tool has put in {account:.3g} J'
            )
        self._account = min(account, energy)
        self._peak = max(_MEMORY * self._peak, self._account)
        return ''

    def lost(self, before: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the nodes of unattached pieces that were pushed beyond the limit.

        No force brings such a piece back: other steps do not help, and every later frame would
        diverge.

        Args:
            before, u: displacement before and after the frame [m], shape (n, 3).

        Returns:
            Sorted, shape (k,). None if a node of attached tissue has moved too far, or the piece
            was less than half as far before: then the step is the cause.
        """
        gone, mesh = ~(np.abs(u) < self._size).all(axis=1), self._mesh
        none = np.zeros(0, np.int64)
        if not gone.any() or not mesh.fixed.any():
            return none
        piece = components(mesh.node_count, mesh.tetrahedra[:, EDGES].reshape(-1, 2))[1]
        far = np.unique(piece[gone])
        on_the_way = piece[(np.abs(before) > self._size / 2).any(axis=1)]
        if np.isin(far, piece[mesh.fixed == 1]).any() or not np.isin(far, on_the_way).all():
            return none
        return np.flatnonzero(np.isin(piece, far))

    def inverted(self, u: np.ndarray) -> int:
        """Return the number of inverted tetrahedra at a displacement [m], shape (n, 3)."""
        volumes = tetrahedron_volumes(self._mesh.rest + u, self._mesh.tetrahedra)
        return int(np.sum(~(volumes > 0)))
