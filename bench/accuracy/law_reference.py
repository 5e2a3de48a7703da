"""Reference of the stiffening law: quadratic hexahedra of scikit-fem, Newton's method.

Shape functions and quadrature are scikit-fem's; stress and tangent are written here a second time,
by tensors instead of components, so that an error of the trainer's law does not cancel.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from cutting_trainer.session.errors import SessionError

Floats = NDArray[np.float64]
Motion = Callable[[Floats, float], Floats]
"""Displacement of held places [m], of their positions, shape (k, 3), and a share of the load."""

MIN_PART = 1e-3
"""Part of the load below which no equilibrium is tried."""


@dataclass(frozen=True)
class LawSolid:
    """A block with the stiffening law.

    Attributes:
        size: along x, y and z [m].
        youngs_modulus: E [Pa] at small strain.
        poissons_ratio: nu at small strain.
        stiffening: b.
        most: exponent b x above which the exponential continues on its tangent.
    """

    size: tuple[float, float, float]
    youngs_modulus: float
    poissons_ratio: float
    stiffening: float
    most: float = 3.0

    @property
    def lame(self) -> tuple[float, float]:
        """Lambda and mu [Pa]."""
        e, nu = self.youngs_modulus, self.poissons_ratio
        return e * nu / (1 + nu) / (1 - 2 * nu), e / 2 / (1 + nu)


def stress_and_tangent(gradient: Floats, solid: LawSolid) -> tuple[Floats, Floats, Floats]:
    """Return P [Pa], shape (k, 3, 3), dP/dF, shape (k, 3, 3, 3, 3), and energies [Pa], (k,).

    Args:
        gradient: F, shape (k, 3, 3).
        solid: the law.
    """
    lam, mu = solid.lame
    b = solid.stiffening
    away = np.swapaxes(np.linalg.inv(gradient), 1, 2)  # F^-T
    log = np.log(np.linalg.det(gradient))
    x = np.einsum('kij,kij->k', gradient, gradient) - 3 - 2 * log
    y = np.minimum(b * x, solid.most)
    rise = mu * np.exp(y)
    curved = np.where(b * x < solid.most, 2 * b * rise, 0.0)
    strain = gradient - away
    stress = rise[:, None, None] * strain + (lam * log)[:, None, None] * away
    turned = np.einsum('kil,kmj->kijml', away, away)
    tangent = np.einsum('k,ip,jq->kijpq', rise, np.eye(3), np.eye(3))
    tangent += curved[:, None, None, None, None] * np.einsum('kij,kpq->kijpq', strain, strain)
    tangent += lam * np.einsum('kij,kpq->kijpq', away, away)
    tangent += (rise - lam * log)[:, None, None, None, None] * turned
    energy = lam / 2 * log**2
    energy += (
        mu / (2 * b) * (np.exp(y) * (1 + b * x - y) - 1) if b > 0 else mu / 2 * x
    )  # fmt: skip
    return stress, tangent, energy


class LawBlock:
    """A block of quadratic hexahedra, moved by its held places.

    Args:
        solid: the block.
        axes: planes of the grid along x, y and z [m].
        held: which of some places are held, by position, shape (k, 3).
        mirrors: axes across which solid and motion are symmetric. Their planes begin in the
            middle, so that the grid is a half or a quarter.
    """

    def __init__(
        self,
        solid: LawSolid,
        axes: tuple[Floats, Floats, Floats],
        held: Callable[[Floats], NDArray[np.bool_]],
        mirrors: tuple[int, ...] = (),
    ) -> None:
        self.solid = solid
        self._mirrors = mirrors
        mesh = skfem.MeshHex.init_tensor(*axes)
        basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=5)
        self._gradients = np.stack([np.asarray(field[0].grad) for field in basis.basis])
        self._weights = np.asarray(basis.dx)
        self._dofs = np.asarray(basis.element_dofs)
        places = np.asarray(basis.doflocs.T)
        self._place = places
        kinds = (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs)
        self._axis = np.zeros(len(places), np.int64)
        for dofs in kinds:
            for axis in range(3):
                self._axis[dofs[axis]] = axis
        self._held = held(places)
        for axis in mirrors:
            self._held |= (self._axis == axis) & (places[:, axis] < solid.size[axis] / 2 + 1e-9)
        d, e, q = len(self._dofs), self._dofs.shape[1], self._weights.shape[1]
        # Element by element: derivatives by component and point, shape (e, d, 9 q).
        self._local = np.moveaxis(self._gradients.reshape(d, 9, e, q), 2, 0).reshape(e, d, 9 * q)
        self._points = q
        # The same point by point, shape (e, q, d, 9).
        moved = np.moveaxis(self._local.reshape(e, d, 9, q), 3, 1)
        self._by_point = np.ascontiguousarray(moved)
        left = np.moveaxis(self._by_point, 2, 1).reshape(e, d, -1)
        self._turned = np.ascontiguousarray(np.swapaxes(left, 1, 2))
        self.u = np.zeros(len(places))

    def _assembled(self, u: Floats) -> tuple[Floats, coo_matrix, float]:
        (d, e), q = self._dofs.shape, self._points
        h = np.einsum('ed,edp->ep', u[self._dofs].T, self._local).reshape(e, 9, q)
        gradient = np.moveaxis(h, 1, 2).reshape(-1, 3, 3) + np.eye(3)
        if np.linalg.det(gradient).min() <= 0.05:
            raise SessionError('the reference is pressed flat')
        stress, tangent, energy = stress_and_tangent(gradient, self.solid)
        w = self._weights.reshape(e, q)
        p = np.moveaxis(stress.reshape(e, q, 9) * w[..., None], 1, 2).reshape(e, 9 * q)
        force = np.zeros(len(u))
        np.add.at(force, self._dofs.T, np.einsum('edp,ep->ed', self._local, p))
        change = tangent.reshape(e, q, 9, 9) * w[..., None, None]
        right = self._by_point @ np.ascontiguousarray(change)
        right = np.ascontiguousarray(np.moveaxis(right, 2, 1)).reshape(e, d, -1)
        blocks = right @ self._turned
        rows, columns = np.broadcast_arrays(self._dofs.T[:, :, None], self._dofs.T[:, None, :])
        matrix = coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())))
        return force, matrix, float((energy.reshape(e, q) * w).sum())

    def settle(self, motion: Motion, share: float) -> float:
        """Move the held places, and the others to equilibrium; return the energy of the grid [J].

        Args:
            motion: of the held places.
            share: of the load.

        Raises:
            SessionError: Newton's method does not converge.
        """
        free = ~self._held
        moved = motion(self._place, share)[np.arange(len(self._axis)), self._axis]
        change = np.where(self._held, moved - self.u, 0.0)
        first = 0.0
        for _ in range(25):
            force, matrix, energy = self._assembled(self.u)
            tangent = matrix.tocsr()
            right = -(force + tangent @ change)[free]
            step = change.copy()
            inside = tangent[free][:, free].tocsc()
            factors = splu(
                inside, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                options={'SymmetricMode': True},
            )  # fmt: skip
            step[free] = factors.solve(right)
            size = float(np.abs(step).max())
            first = max(first, size)
            self._go(step)
            change = np.where(self._held, moved - self.u, 0.0)
            if size < 1e-4 * first and float(np.abs(change).max()) < 1e-12:
                return energy
        raise SessionError('the reference has no equilibrium')

    def follow(self, motion: Motion, steps: int) -> None:
        """Move the held places from rest to the end of a motion, in parts.

        A part that finds no equilibrium is halved; the next one starts along the last one's way.

        Args:
            motion: of the held places.
            steps: parts, if none is halved.

        Raises:
            SessionError: no equilibrium is found on the way.
        """
        done, part, rate = 0.0, 1 / steps, np.zeros_like(self.u)
        while done < 1 - 1e-9:
            share, before = min(done + part, 1.0), self.u.copy()
            try:
                with suppress(SessionError):
                    self._go(np.where(self._held, 0.0, (share - done) * rate))
                self.settle(motion, share)
            except SessionError:
                self.u, part, rate = before, part / 2, 0.0 * rate
                if part < MIN_PART:
                    raise
                continue
            rate = (self.u - before) / (share - done)
            done = share

    def _go(self, step: Floats) -> None:
        for part in 0.5 ** np.arange(8):
            try:
                self._least_ratio(self.u + part * step)
            except SessionError:
                continue
            self.u = self.u + part * step
            return
        raise SessionError('the reference is pressed flat')

    def _least_ratio(self, u: Floats) -> None:
        e, q = self._dofs.shape[1], self._points
        h = np.einsum('ed,edp->ep', u[self._dofs].T, self._local).reshape(e, 9, q)
        if np.linalg.det(np.moveaxis(h, 1, 2).reshape(-1, 3, 3) + np.eye(3)).min() <= 0.1:
            raise SessionError('the reference is pressed flat')

    def force(self, motion: Motion, share: float) -> float:
        """Return the force of the motion, work by share of the load [J]."""
        force = self._assembled(self.u)[0]
        d = 1e-6
        rate = (motion(self._place, share + d) - motion(self._place, share - d)) / (2 * d)
        along = rate[np.arange(len(self._axis)), self._axis]
        return 2 ** len(self._mirrors) * float(force[self._held] @ along[self._held])

    def displacement(self) -> tuple[Floats, Floats]:
        """Return places [m] and their displacement [m], shape (k, 3)."""
        mesh_places, inverse = np.unique(np.round(self._place, 9), axis=0, return_inverse=True)
        u = np.zeros_like(mesh_places)
        u[inverse.ravel(), self._axis] = self.u
        return mesh_places, u

    def at(self, points: Floats) -> Floats:
        """Return the displacement at points [m], shape (k, 3), by quadratic interpolation."""
        points, turned = points.copy(), np.ones_like(points)
        for axis in self._mirrors:
            away = points[:, axis] - self.solid.size[axis] / 2
            turned[:, axis] = np.where(away < 0.0, -1.0, 1.0)
            points[:, axis] += np.abs(away) - away
        places, u = self.displacement()
        axes: Sequence[Floats] = [np.unique(places[:, i]) for i in range(3)]
        grid = np.zeros((*(len(a) for a in axes), 3))
        index = [np.searchsorted(a, places[:, i]) for i, a in enumerate(axes)]
        grid[index[0], index[1], index[2]] = u
        weights = []
        for i, a in enumerate(axes):
            cell = np.clip(np.searchsorted(a[::2], points[:, i], 'right') - 1, 0, len(a) // 2 - 1)
            left, right = a[2 * cell], a[2 * cell + 2]
            t = (points[:, i] - left) / (right - left)
            weights.append((2 * cell, [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)]))
        result = np.zeros_like(points)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    w = weights[0][1][i] * weights[1][1][j] * weights[2][1][k]
                    at = weights[0][0] + i, weights[1][0] + j, weights[2][0] + k
                    result += w[:, None] * grid[at]
        return turned * result
