"""Problems of the chart: a mesh of any resolution, a load, and the reference.

Each is small enough to be solved on a desk and has a reference of its own (`chart_reference`).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.law_problems import (
    CASES,
    SIDE,
    errors_at,
    followed,
    solved_reference,
    unstructured_block,
)
from bench.accuracy.law_reference import LawBlock
from bench.accuracy.reference import (
    Converged,
    ExactBeam,
    HexGrid,
    Solid,
    exact_beam,
    extrapolated,
    graded,
)
from bench.common.meshes import PLANE_TOLERANCE_M, beam, end_load, kuhn_block, on_plane, pressed
from bench.cuts.strokes import results_along
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.material_presets import PRESETS
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.mesh.topology import CUT
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

Floats = NDArray[np.float64]

ALPHA, BETA = 1.0, 1e-4
"""Damping of the cost measurement [1/s], [s]; it does not change the rest state."""
_SETTLING_FRAMES = 12
"""Frames in which the bound of the frequency settles after a cut."""


@dataclass(frozen=True)
class Errors:
    """Relative errors against the reference.

    Attributes:
        displacement: of the displacement under the given load [-].
        force: of the force for the given displacement [-].
    """

    displacement: float
    force: float


@dataclass(frozen=True)
class Rest:
    """A tissue at rest under its load.

    Attributes:
        model: the elastic model.
        displacement: [m], shape (n, 3).
        errors: against the reference.
    """

    model: ElasticModel
    displacement: Floats
    errors: Errors


def material(solid: Solid) -> Material:
    """Material of a solid, with the damping of the cost measurement."""
    return Material(solid.youngs_modulus, solid.poissons_ratio, solid.density, ALPHA, BETA)


def _linear_response(model: ElasticModel, load: Floats, exact: float) -> Rest:
    """Return the rest under a load, with its work over its size beside an exact settlement [m]."""
    u = equilibrium(model, load)
    settlement = float(np.sum(load * u) / np.abs(load[:, 2]).sum())
    ratio = settlement / exact
    return Rest(model, u, Errors(abs(ratio - 1), abs(1 / ratio - 1)))


class Indentation:
    """A block fixed at its underside, under a smooth pressure on 4 x 4 cm of its top."""

    name = 'indentation'
    title = 'Static indentation, ν 0.47'
    reference_name = 'scikit-fem, quadratic hexahedra, extrapolated'
    resolutions = (4, 8, 12)
    solid = Solid((0.10, 0.10, 0.04), 5000.0, 0.47)
    _reach, _force = 0.02, 0.01

    def _pressure(self, x: Floats, y: Floats) -> Floats:
        r, middle = self._reach, self.solid.size[0] / 2
        inside = (abs(x - middle) < r) & (abs(y - middle) < r)
        bump = np.cos(np.pi * (x - middle) / 2 / r) * np.cos(np.pi * (y - middle) / 2 / r)
        return np.where(inside, bump**2, 0.0) * self._force / r**2

    @cached_property
    def reference(self) -> Converged:
        """Settlement under the load, averaged over it [m]: a quarter of the block suffices."""
        return extrapolated(*(self._quarter(k) for k in (2, 4, 8)))

    def _quarter(self, deep: int) -> float:
        solid = Solid((0.05, 0.05, 0.04), self.solid.youngs_modulus, self.solid.poissons_ratio)
        side = graded(solid.size[0], 5 * deep // 4)
        grid = HexGrid(solid, (side, side, graded(solid.size[2], deep)))
        x = grid.places
        held = [grid.components(x[:, 2] < PLANE_TOLERANCE_M, axis) for axis in range(3)]
        held += [
            grid.components(x[:, axis] > solid.size[axis] - PLANE_TOLERANCE_M, axis)
            for axis in (0, 1)
        ]
        load = grid.traction(
            lambda p: p[2] > solid.size[2] - PLANE_TOLERANCE_M, lambda x, y, z: self._pressure(x, y)
        )
        u = grid.solve(load, np.unique(np.concatenate(held)))
        return float(4 * load @ u / self._force)

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the block, with so many bricks over its depth, at rest under the load."""
        across = 5 * resolution // 2
        whole = kuhn_block((across, across, resolution), self.solid.size)
        mesh = TetMesh(whole.rest, whole.tetrahedra, whole.rest[:, 2] < PLANE_TOLERANCE_M)
        load = pressed(
            mesh,
            on_plane(mesh, 2, self.solid.size[2]),
            lambda points: self._pressure(points[:, 0], points[:, 1]),
        )
        return _linear_response(
            ElasticModel(mesh, material(self.solid), model), load, self.reference.value
        )


class Cantilever:
    """A beam 10 x 2 x 2 cm clamped at one end, a small dead load spread over the other.

    Args:
        poissons_ratio: of its material [-].

    Attributes:
        force: the load [N].
    """

    reference_name = 'scikit-fem, quadratic hexahedra, extrapolated'
    resolutions = (2, 4, 8)
    force = 2e-5

    def __init__(self, poissons_ratio: float) -> None:
        self.solid = Solid((0.10, 0.02, 0.02), 5000.0, poissons_ratio)
        self.name = f'cantilever_{poissons_ratio:g}'
        self.title = f'Cantilever, ν {poissons_ratio:g}'

    @cached_property
    def reference(self) -> Converged:
        """Deflection of the loaded end [m]: half of the beam suffices."""
        return extrapolated(*(self._half(k) for k in (2, 4, 8)))

    def _half(self, deep: int) -> float:
        length, width, height = self.solid.size
        solid = Solid(
            (length, width / 2, height), self.solid.youngs_modulus, self.solid.poissons_ratio
        )
        planes = (
            graded(length, 4 * deep, (0.0,)),
            graded(width / 2, max(deep // 2, 2), (0.0,)),
            graded(height, deep, (0.0, height)),
        )
        grid = HexGrid(solid, planes)
        x = grid.places
        held = [grid.components(x[:, 0] < PLANE_TOLERANCE_M, axis) for axis in range(3)]
        held.append(grid.components(x[:, 1] > width / 2 - PLANE_TOLERANCE_M, 1))
        area = width * height
        load = grid.traction(
            lambda p: p[0] > length - PLANE_TOLERANCE_M, lambda x, y, z: self.force / area + 0 * x
        )
        u = grid.solve(load, np.unique(np.concatenate(held)))
        return float(2 * load @ u / self.force)

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the beam, with so many bricks over its depth, at rest under the load."""
        mesh = beam(self.solid, resolution)
        load = end_load(mesh, self.solid, self.force)
        return _linear_response(
            ElasticModel(mesh, material(self.solid), model), load, self.reference.value
        )


class LargeRotation:
    """A slender beam bent by a dead load until its end has turned by 45 degrees; nu = 0."""

    name = 'large_rotation'
    title = 'Large rotation, 45° at the end of a beam'
    reference_name = 'exact plane beam (Reissner 1972), solved by scipy'
    resolutions = (2, 4, 6)
    solid = Solid((0.10, 0.01, 0.01), 5000.0, 0.0)
    _steps = 5

    @property
    def load(self) -> float:
        """Force at the end [N]: twice the bending stiffness over the square of the length."""
        length, width, height = self.solid.size
        return 2 * self.solid.youngs_modulus * width * height**3 / 12 / length**2

    @cached_property
    def reference(self) -> ExactBeam:
        """Displacement and rotation of the end."""
        return exact_beam(self.solid, self.load)

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the beam under the load, and once more with its end held where the reference has
        it.
        """
        mesh = beam(self.solid, resolution)
        elastic = ElasticModel(mesh, material(self.solid), model)
        load = end_load(mesh, self.solid, self.load)
        u = np.zeros_like(mesh.rest)
        for share in np.arange(1, self._steps + 1) / self._steps:
            u = equilibrium(elastic, share * load, start=u)
        exact = self.reference
        tip = (load[:, 2] @ u) / load[:, 2].sum()
        off = float(np.hypot(tip[0] - exact.along, tip[2] + exact.down))
        wrong = off / float(np.hypot(exact.along, exact.down))
        return Rest(elastic, u, Errors(wrong, abs(self._reaction(elastic, u) / self.load - 1)))

    def _reaction(self, model: ElasticModel, start: Floats) -> float:
        mesh, exact, length = model.mesh, self.reference, self.solid.size[0]
        end = mesh.rest[:, 0] > length - PLANE_TOLERANCE_M
        c, s = np.cos(exact.slope), np.sin(exact.slope)
        arm = mesh.rest[end] - [length, 0.0, self.solid.size[2] / 2]
        target = np.stack([c * arm[:, 0] + s * arm[:, 2], arm[:, 1], c * arm[:, 2]], axis=1)
        target[:, 2] -= s * arm[:, 0]
        target += [exact.along, 0.0, -exact.down] - arm
        held = end | (mesh.fixed == 1)
        u = start.copy()
        before = u[end].copy()
        for share in np.arange(1, 4) / 3:
            u[end] = before + share * (target - before)
            u = equilibrium(model, np.zeros_like(u), held=held, start=u)
        return -float(model.force(u)[end, 2].sum())


class AfterCut:
    """A block notched by the blade to half its depth and pulled apart by 1 %, between clamps."""

    name = 'after_cut'
    title = 'After a cut: a notched block, stretched'
    reference_name = 'scikit-fem with a slit, quadratic hexahedra, extrapolated'
    resolutions = (6, 10, 14)
    solid = Solid((0.06, 0.02, 0.04), 5000.0, 0.47)
    _stretch = 0.01

    @cached_property
    def reference(self) -> tuple[Converged, Converged]:
        """Force [N] and volume of the opening [m^3]; half of the block suffices."""
        found = [self._half(k) for k in (3, 6, 12)]
        return (
            extrapolated(*(force for force, _ in found)),
            extrapolated(*(opening for _, opening in found)),
        )

    def _half(self, deep: int) -> tuple[float, float]:
        length, width, height = self.solid.size
        solid = Solid(
            (length, width / 2, height), self.solid.youngs_modulus, self.solid.poissons_ratio
        )
        planes = (
            graded(length, 2 * deep, (0.0, self._plane, length)),
            graded(width / 2, max(deep // 4, 1), (0.0,)),
            graded(height, deep, (height / 2,)),
        )
        grid = HexGrid(solid, planes, slit=(self._plane, height / 2))
        x = grid.places
        ends = (x[:, 0] < PLANE_TOLERANCE_M) | (x[:, 0] > length - PLANE_TOLERANCE_M)
        held = [grid.components(ends, axis) for axis in range(3)]
        pulled = grid.components(x[:, 0] > length - PLANE_TOLERANCE_M, 0)
        held.append(grid.components(x[:, 1] > width / 2 - PLANE_TOLERANCE_M, 1))
        fixed = np.unique(np.concatenate(held))
        values = np.where(np.isin(fixed, pulled), self._stretch * length, 0.0)
        u = grid.solve(np.zeros(len(x)), fixed, values)
        force = 2 * float((grid.stiffness @ u)[pulled].sum())
        return force, 2 * grid.opening(u, self._plane)

    @property
    def _plane(self) -> float:
        return 0.75 * self.solid.size[0]

    def whole(self, resolution: int) -> TetMesh:
        """Return the block before the cut, with so many bricks over its depth."""
        bricks = (3 * resolution // 2, resolution // 2, resolution)
        mesh = kuhn_block(bricks, self.solid.size)
        x = mesh.rest[:, 0]
        return TetMesh(
            mesh.rest,
            mesh.tetrahedra,
            (x < PLANE_TOLERANCE_M) | (x > self.solid.size[0] - PLANE_TOLERANCE_M),
        )

    def cut(self, mesh: TetMesh) -> list[TopologyDelta]:
        """Draw the blade through a block; return the changes that it has made."""
        method, deltas = make_method(CuttingSettings()), []
        _, width, height = self.solid.size
        way = np.linspace(-0.3 * width, 1.3 * width, 9)
        x = self._plane
        path = np.array([[[x, y, 1.2 * height], [x, y, height / 2]] for y in way])
        for result in results_along(method, mesh, path):
            if not result.delta.empty:
                mesh.apply(result.delta)
                deltas.append(result.delta)
        return deltas

    def dynamics(self, model: ModelName, resolution: int, stepping: TimeStepping) -> Dynamics:
        """Return the block as it moves after the cut.

        Small nodes have got mass, as in a session.
        """
        deltas = self.cut(self.whole(resolution))
        dynamics = Dynamics(self.whole(resolution), material(self.solid), model, stepping)
        for delta in deltas:
            dynamics.apply_cut(delta)
        for _ in range(_SETTLING_FRAMES):
            dynamics.advance(Coupling())
        return dynamics

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the block at rest between the clamps."""
        mesh = self.whole(resolution)
        self.cut(mesh)
        far = mesh.rest[:, 0] > self.solid.size[0] - PLANE_TOLERANCE_M
        elastic = ElasticModel(mesh, material(self.solid), model)
        u = np.zeros_like(mesh.rest)
        u[far, 0] = self._stretch * self.solid.size[0]
        u = equilibrium(elastic, np.zeros_like(u), start=u)
        faces = mesh.triangles[mesh.triangle_kind == CUT]
        corners = mesh.rest[faces]
        areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        opening = -float(np.einsum('ij,ij->', u[faces].mean(axis=1), areas))
        force, width = (value.value for value in self.reference)
        pull = float(elastic.force(u)[far, 0].sum())
        return Rest(elastic, u, Errors(abs(opening / width - 1), abs(pull / force - 1)))


class LargeStrain:
    """A block of human liver, strained as in a case of `law_problems`; nodes are scattered.

    Args:
        case: name of the case.
    """

    reference_name = 'scikit-fem, quadratic hexahedra with the law that stiffens'
    _titles = {  # noqa: RUF012
        'punch 10 %': 'Punch of 10 %: a block that stiffens, scattered nodes',
        'press 30 %': 'Large strain: a cube that stiffens, pressed by 30 %',
    }
    _seed = 1

    def __init__(self, case: str) -> None:
        self._case = CASES[case]
        self.name = 'punch_10' if self._case.punched else 'large_strain'
        self.title = self._titles[case]
        self.resolutions = (4, 8, 12) if self._case.punched else (4, 6, 8)
        self.solid = Solid(self._case.size, 5400.0, 0.47)

    @property
    def _stiffening(self) -> float:
        return PRESETS['liver_human'].numbers['stiffening'].value

    @cached_property
    def reference(self) -> LawBlock:
        """The strained block."""
        nu, cells = self.solid.poissons_ratio, self._case.cells
        return solved_reference(self._case, nu, self._stiffening, cells)

    def rest(self, model: ModelName, resolution: int) -> Rest:
        """Return the block, with so many edges over its side, at rest between the clamps."""
        mesh = unstructured_block(self._case, SIDE / resolution, self._seed)
        stiff = replace(material(self.solid), stiffening=self._stiffening)
        elastic = ElasticModel(mesh, stiff, model)
        if model.startswith('linear'):
            start = np.where(mesh.fixed[:, None] == 1, self._case.motion(mesh.rest, 1.0), 0.0)
            u = equilibrium(elastic, np.zeros_like(start), start=start)
        else:
            u = followed(self._case, elastic)
        found = errors_at(self._case, self.reference, elastic, u)
        return Rest(elastic, u, Errors(found.field, abs(found.force)))
