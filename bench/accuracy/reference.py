"""References of the chart's problems, from solvers that share nothing with the trainer.

Linear problems: scikit-fem, quadratic hexahedra on two grids, extrapolated. Large rotation: the
geometrically exact plane beam (Reissner 1972) as a boundary value problem for scipy.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import eigsh, splu

from cutting_trainer.session.errors import SessionError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A box of linear isotropic material.

    Attributes:
        size: along x, y and z [m].
        youngs_modulus: [Pa].
        poissons_ratio: [-].
        density: [kg/m^3].
    """

    size: tuple[float, float, float]
    youngs_modulus: float
    poissons_ratio: float
    density: float = 1050.0


@dataclass(frozen=True)
class Converged:
    """A value and its uncertainty.

    Attributes:
        value: extrapolated.
        uncertainty: relative difference between it and the finest grid's value.
    """

    value: float
    uncertainty: float


def graded(length: float, cells: int, toward: tuple[float, ...] = ()) -> Floats:
    """Return planes of a grid, closer to each other towards places where stress is singular.

    Args:
        length: of the axis, which begins at 0 [m].
        cells: how many, shared among the parts by their lengths.
        toward: places, in order [m].
    """
    if not toward:
        return np.linspace(0.0, length, cells + 1)
    stops = sorted({0.0, length, *toward})
    halves: list[tuple[float, float]] = []  # from a place to where the next one takes over
    for a, b in pairwise(stops):
        near_a, near_b = a in toward, b in toward
        middle = (a + b) / 2
        halves += (
            [(a, middle), (b, middle)] if near_a and near_b else [(a, b) if near_a else (b, a)]
        )
    planes = {0.0, length}
    for start, end in halves:
        count = max(round(cells * abs(end - start) / length), 1)
        share = (np.arange(count + 1) / count) ** 2
        planes |= set(np.round(start + share * (end - start), 12).tolist())
    return np.array(sorted(planes))


class HexGrid:
    """A box meshed by quadratic hexahedra, its matrices assembled by scikit-fem.

    Args:
        solid: the box and its material.
        axes: planes of the grid along x, y and z, from 0 to the size [m].
        slit: None, or (x, z): the plane at x is open where z is above the second value [m].

    Raises:
        SessionError: scikit-fem is not installed.
    """

    def __init__(
        self,
        solid: Solid,
        axes: tuple[Floats, Floats, Floats],
        slit: tuple[float, float] | None = None,
    ) -> None:
        skfem, elasticity = _scikit_fem()
        self.solid = solid
        mesh = skfem.MeshHex.init_tensor(*axes)
        if slit is not None:
            mesh = _slit(skfem, mesh, *slit)
        self._basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
        self._skfem = skfem
        nu, modulus = solid.poissons_ratio, solid.youngs_modulus
        lame = modulus * nu / (1 + nu) / (1 - 2 * nu), modulus / (2 * (1 + nu))
        self.stiffness: csr_matrix = elasticity.linear_elasticity(*lame).assemble(self._basis)
        self.places: Floats = np.asarray(self._basis.doflocs.T)

    def components(self, where: NDArray[np.bool_], axis: int) -> NDArray[np.int64]:
        """Return degrees of freedom of a direction at chosen places; `where` has shape (dofs,)."""
        belongs = np.zeros(len(where), bool)
        for dofs in (self._basis.nodal_dofs, self._basis.edge_dofs, self._basis.facet_dofs):
            belongs[dofs[axis]] = True
        belongs[self._basis.interior_dofs[axis]] = True
        return np.flatnonzero(belongs & where)

    def traction(self, face: Callable[[Floats], Any], pressure: Callable[..., Any]) -> Floats:
        """Return the load of a pressure p(x, y, z) [Pa] along -z on a part of the surface.

        Args:
            face: of the middles of the boundary's faces, shape (3, f): which are loaded.
            pressure: of the three coordinates.
        """
        skfem = self._skfem

        @skfem.LinearForm
        def work(v: Any, w: Any) -> Any:
            return -pressure(*w.x) * v[2]

        basis = self._basis.boundary(self._basis.mesh.facets_satisfying(face, boundaries_only=True))
        return np.asarray(work.assemble(basis))

    def opening(self, u: Floats, x: float) -> float:
        """Return volume that a slit in the plane at x opens by [m^3], for a displacement [m]."""
        skfem = self._skfem
        mesh = self._basis.mesh
        facets = mesh.facets_satisfying(lambda p: abs(p[0] - x) < 1e-9, boundaries_only=True)
        basis = self._basis.boundary(facets)

        @skfem.Functional
        def outward(w: Any) -> Any:
            return -w['u'][0] * w.n[0]

        return float(outward.assemble(basis, u=basis.interpolate(u)))

    def mass(self) -> csr_matrix:
        """Return consistent mass matrix [kg]."""
        density = self.solid.density

        @self._skfem.BilinearForm
        def form(u: Any, v: Any, w: Any) -> Any:
            return density * (u[0] * v[0] + u[1] * v[1] + u[2] * v[2])

        return form.assemble(self._basis)

    def solve(self, load: Floats, held: NDArray[np.int64], values: Floats | float = 0.0) -> Floats:
        """Return displacement [m] under a load [N], some degrees of freedom held."""
        u = np.zeros(len(load))
        u[held] = values
        free = np.setdiff1d(np.arange(len(load)), held)
        right = load[free] - (self.stiffness @ u)[free]
        u[free] = splu(self.stiffness[free][:, free].tocsc()).solve(right)
        return u

    def lowest_mode(self, held: NDArray[np.int64]) -> tuple[float, Floats]:
        """Return lowest natural frequency [rad/s] and its mode, mass-normalised."""
        size = self.stiffness.shape[0]
        free = np.setdiff1d(np.arange(size), held)
        k, m = (a[free][:, free].tocsc() for a in (self.stiffness, self.mass()))
        start = np.random.default_rng(0).standard_normal(len(free))
        square, vector = eigsh(k, k=1, M=m, sigma=0.0, v0=start)
        mode = np.zeros(size)
        mode[free] = vector[:, 0]
        return float(np.sqrt(square[0])), mode


def extrapolated(coarse: float, middle: float, fine: float) -> Converged:
    """Return the limit of a sequence on grids with halved cells (Aitken's extrapolation)."""
    first, second = middle - coarse, fine - middle
    rate = second / first if abs(second) < abs(first) else 0.5
    limit = fine + second * rate / (1 - rate) if rate > 0 else fine
    return Converged(limit, abs(limit - fine) / abs(limit))


@dataclass(frozen=True)
class ExactBeam:
    """Tip of a cantilever under a dead load, after Reissner 1972.

    Attributes:
        along, down: displacement of the tip [m].
        slope: its rotation [rad].
    """

    along: float
    down: float
    slope: float


def exact_beam(solid: Solid, load: float) -> ExactBeam:
    """Return the plane beam with axial and shear strain, no limit on rotations, clamped at x = 0.

    Args:
        solid: its size; cross-section constants with the shear coefficient of a rectangle
            10 (1 + nu) / (12 + 11 nu).
        load: at the tip, along -z, its direction kept [N].
    """
    length, width, height = solid.size
    modulus, nu = solid.youngs_modulus, solid.poissons_ratio
    area, inertia = width * height, width * height**3 / 12
    axial, bending = modulus * area, modulus * inertia
    shear = 10 * (1 + nu) / (12 + 11 * nu) * modulus / (2 * (1 + nu)) * area

    def slopes(s: Floats, y: Floats) -> Floats:
        angle, moment = y[2:]
        c, w = np.cos(angle), np.sin(angle)
        stretch, slide = 1 + load * w / axial, load * c / shear
        along, down = stretch * c - slide * w, stretch * w + slide * c
        return np.vstack([along, down, moment / bending, -load * along])

    def ends(a: Floats, b: Floats) -> Floats:
        return np.array([a[0], a[1], a[2], b[3]])

    s = np.linspace(0, length, 201)
    guess = np.vstack([s, 0 * s, 0 * s, load * (length - s)])
    solution = solve_bvp(slopes, ends, s, guess, tol=1e-8, max_nodes=20000)
    x, z, angle, _ = solution.y[:, -1]
    return ExactBeam(float(x - length), float(z), float(angle))


def _slit(skfem: Any, mesh: Any, x: float, bottom: float) -> Any:
    """Return the mesh with its nodes on a part of a plane doubled."""
    points, cells = mesh.p, mesh.t
    on = (abs(points[0] - x) < 1e-9) & (points[2] > bottom + 1e-9)
    twin = np.arange(points.shape[1])
    twin[on] = points.shape[1] + np.arange(on.sum())
    right = points[0][cells].mean(axis=0) > x
    return skfem.MeshHex(np.hstack([points, points[:, on]]), np.where(right, twin[cells], cells))


def _scikit_fem() -> tuple[Any, Any]:
    try:
        import skfem
        from skfem.models import elasticity
    except ImportError:
        raise SessionError(
            'the references of the chart come from scikit-fem, which is not installed: '
            'run ./trainer setup, or pip install -r requirements-test.txt'
        ) from None
    return skfem, elasticity
