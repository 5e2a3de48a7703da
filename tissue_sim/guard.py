"""What must not be felt: energy from nowhere, a tissue that leaves, a tool that jumps."""

import numpy as np

from tissue_sim.mesh import TetMesh, tetrahedron_volumes
from tissue_sim.mesh_checks import EDGES, components

TOOL_SPEED = 3.0
"""[m/s] above which a tool has not moved but jumped; hands come to 2."""
_FACTOR = 3.0
_MEMORY = 0.95
_SHARE = 0.1
_LEAST_STRAIN = 1e-4


class Guard:
    """Judges frames by an account of energy: what the tissue has, the tool has put in.

    An integrator beyond its limit makes energy, and does so long before a node is anywhere it
    should not be. Damping only takes away, so the account is the lesser of what was there plus the
    tool's work, and what is there. More than three times the account, and more than a tenth of what
    it lately was, is trouble; the slack is for the work being a sum over steps.

    Args:
        mesh: the tissue.
        youngs_modulus: [Pa].
    """

    def __init__(self, mesh: TetMesh, youngs_modulus: float) -> None:
        self._mesh = mesh
        self._size = float(np.linalg.norm(np.ptp(mesh.rest, axis=0)))
        self._floor = youngs_modulus * float(mesh.volumes().sum()) * _LEAST_STRAIN**2
        self._account = 0.0
        self._peak = 0.0

    def open(self, energy: float) -> None:
        """Starts the account anew with what is there [J]: after a cut, say."""
        self._account = energy

    def trouble(self, u: np.ndarray, energy: float, work: float) -> str:
        """What is wrong with a frame, in words; empty: nothing, and the account goes on.

        Args:
            u: displacement [m], shape (n, 3).
            energy: kinetic and elastic [J].
            work: of the tool in this frame [J].
        """
        farthest = float(np.abs(u).max(initial=0.0))
        if not farthest < self._size:  # also true for NaN
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
        """Nodes of loose pieces that have been pushed so far that the frame is trouble.

        Nothing brings such a piece back: other steps are of no help, and every frame that follows
        would be trouble too.

        Args:
            before, u: displacement before and after the frame [m], shape (n, 3).

        Returns:
            Sorted, shape (k,); none where a node of tissue that is held has moved too far, or the
            piece was not half as far before: then it is the step that is to blame.
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
        """How many tetrahedra are turned inside out at a displacement [m], shape (n, 3)."""
        volumes = tetrahedron_volumes(self._mesh.rest + u, self._mesh.tetrahedra)
        return int(np.sum(~(volumes > 0)))
