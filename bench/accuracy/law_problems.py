"""Large strains of the stiffening law against quadratic elements of the same law.

`./trainer run python -m bench.accuracy.law_problems [NAME ...]` prints one table: hours for all
cases, minutes for one.
"""

import argparse
import time
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from bench.accuracy.law_reference import MIN_PART, LawBlock, LawSolid, Motion
from bench.accuracy.reference import graded
from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import (
    STRAIN_TOLERANCE,
    ElasticModel,
    ModelName,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SIDE = 0.04
"""Edge of the block that is pulled, pressed and twisted [m]."""
SLENDER = (0.02, 0.02, 0.08)
"""Bar that is bent [m]."""
PATCH = 0.02
"""Edge of the square punch [m]."""
STIFFENING, RATIOS, SEED = 6.0, (0.45, 0.49), 1
"""b, Poisson's ratios, and seed of the meshes of the table."""


@dataclass(frozen=True)
class Case:
    """A motion of a block's ends.

    Attributes:
        name: of the case.
        size: of the block [m].
        motion: of the held places, for a share of the load.
        punched: whether only the punch on the upper side is held there, else all of it.
        steps: parts of the load.
        mirrors: axes across which the motion is symmetric about the middle.
        edge: mean edge of the table's meshes [m].
        cells: of the table's reference, see `solved_reference`.
    """

    name: str
    size: tuple[float, float, float]
    motion: Motion
    punched: bool = False
    steps: int = 6
    mirrors: tuple[int, ...] = (0, 1)
    edge: float = 0.004
    cells: int = 6

    def held(self, points: Floats) -> Bools:
        """Return which points are held."""
        height = self.size[2]
        upper = points[:, 2] > height - 1e-9
        if self.punched:
            middle = np.array(self.size[:2]) / 2
            upper &= (np.abs(points[:, :2] - middle) < PATCH / 2 + 1e-9).all(axis=1)
        return np.asarray((points[:, 2] < 1e-9) | upper)


def lifted(points: Floats, share: float, *, height: float, most: float) -> Floats:
    out = np.zeros_like(points)
    out[:, 2] = np.where(points[:, 2] > height / 2, share * most * height, 0.0)
    return out


def _twisted(points: Floats, share: float, *, size: tuple[float, ...], most: float) -> Floats:
    middle = np.array(size[:2]) / 2
    angle = np.where(points[:, 2] > size[2] / 2, share * most, 0.0)
    x, y = (points[:, :2] - middle).T
    turned = np.stack([np.cos(angle) * x - np.sin(angle) * y,
                       np.sin(angle) * x + np.cos(angle) * y, points[:, 2]], axis=1)  # fmt: skip
    turned[:, :2] += middle
    return turned - points


def _bent(points: Floats, share: float, *, size: tuple[float, ...], most: float) -> Floats:
    """Turn the upper end as on an arc that keeps the length of the middle."""
    angle = max(share * most, 1e-9)
    radius = size[2] / angle
    x = points[:, 0] - size[0] / 2
    end = np.stack([radius - (radius - x) * np.cos(angle) + size[0] / 2, points[:, 1],
                    (radius - x) * np.sin(angle)], axis=1)  # fmt: skip
    return np.where(points[:, 2:] > size[2] / 2, end - points, 0.0)


def _cases() -> dict[str, Case]:
    cube, flat = (SIDE,) * 3, (SIDE, SIDE, SIDE / 2)
    found = []
    for name, size, most, punched in (
        ('punch 10 %', flat, -0.1, True),
        ('punch 30 %', flat, -0.3, True),
        ('stretch 30 %', cube, 0.3, False),
        ('stretch 50 %', cube, 0.5, False),
        ('press 30 %', cube, -0.3, False),
        ('press 50 %', cube, -0.5, False),
    ):
        motion = partial(lifted, height=size[2], most=most)
        steps = max(3, round(abs(most) * 12))
        edge, cells = (0.0025, 8) if punched else (0.004, 6)
        found.append(Case(name, size, motion, punched, steps, edge=edge, cells=cells))
    bend = partial(_bent, size=SLENDER, most=np.pi / 2)
    found.append(Case('bend 90', SLENDER, bend, steps=8, mirrors=(1,), edge=0.0033))
    for angle in (45, 90):
        twist = partial(_twisted, size=cube, most=np.radians(angle))
        found.append(Case(f'twist {angle}', cube, twist, steps=angle * 6 // 45, mirrors=()))
    return {case.name: case for case in found}


CASES = _cases()


def solid_of(case: Case, nu: float, stiffening: float) -> LawSolid:
    """Return the block of a case, of liver's stiffness."""
    return LawSolid(case.size, 5400.0, nu, stiffening)


def solved_reference(case: Case, nu: float, stiffening: float, cells: int = 6) -> LawBlock:
    """Return the block of quadratic hexahedra in equilibrium.

    Args:
        case: of the motion.
        nu: Poisson's ratio.
        stiffening: b.
        cells: of the grid along the shortest side; 1.4 times as many along one twice as long.
    """
    size = case.size
    parts = (4, 4, 1) if case.punched else (2, 2, 2)  # each of them has as many cells
    counts = [max(cells, round(cells * s / min(size) / 1.4)) for s in size]
    counts = [k * max(round(count / k), 1) for k, count in zip(parts, counts, strict=True)]
    sides = (size[0] / 2 - PATCH / 2, size[0] / 2 + PATCH / 2) if case.punched else (0.0, size[0])
    ends = (size[2],) if case.punched else (0.0, size[2])
    axes = [graded(size[i], counts[i], sides) for i in range(2)]
    if case.name.startswith('bend'):
        axes = [np.linspace(0, s, cells // 2 + 1) for s in size[:2]]
    axes.append(graded(size[2], counts[2], ends))
    for axis in case.mirrors:
        middle = size[axis] / 2
        axes[axis] = np.union1d(middle, axes[axis][axes[axis] > middle + 1e-9])
    planes = axes[0], axes[1], axes[2]
    block = LawBlock(solid_of(case, nu, stiffening), planes, case.held, case.mirrors)
    block.follow(case.motion, case.steps)
    return block


def unstructured_block(case: Case, edge: float, seed: int) -> TetMesh:
    """Return a Delaunay mesh of scattered nodes, the held ones fixed.

    Args:
        case: its block; nodes on the edges of the punch stay there.
        edge: mean distance of the nodes [m].
        seed: of their places.
    """
    rng = np.random.default_rng(seed)
    parts = (4, 4, 2) if case.punched else (2, 2, 2)  # a plane of nodes at each edge of the punch
    counts = [k * max(round(s / edge / k), 1) for k, s in zip(parts, case.size, strict=True)]
    grid = np.argwhere(np.ones([c + 1 for c in counts])).astype(float)
    move = rng.uniform(-0.28, 0.28, grid.shape)
    for axis, count in enumerate(counts):
        still = (grid[:, axis] == 0) | (grid[:, axis] == count)
        if case.punched and axis < 2:
            side = abs(grid[:, axis] - count / 2) * (case.size[axis] / count) - PATCH / 2
            still |= (abs(side) < 0.5 * edge) & (grid[:, 2] == counts[2])
        move[still, axis] = 0.0
    nodes = (grid + move) * (np.array(case.size) / counts)
    if case.punched:
        nodes = _on_the_punch(nodes, case, edge)
    tets = Delaunay(nodes).simplices.astype(np.int64)
    a, b, c, d = (nodes[tets[:, i]] for i in range(4))
    volume = np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a)
    tets[volume < 0, 2:] = tets[volume < 0, :1:-1]
    tets = tets[abs(volume) > 1e-6 * edge**3]
    return TetMesh(nodes, tets, case.held(nodes))


def _on_the_punch(nodes: Floats, case: Case, edge: float) -> Floats:
    """Move nodes of the upper side to the edges of the punch that they are next to."""
    out = nodes.copy()
    upper = nodes[:, 2] > case.size[2] - 1e-9
    for axis in range(2):
        for side in (case.size[axis] - PATCH, case.size[axis] + PATCH):
            near = upper & (abs(nodes[:, axis] - side / 2) < 0.5 * edge)
            out[near, axis] = side / 2
    return out


@dataclass(frozen=True)
class LawError:
    """A model beside the reference.

    Attributes:
        tetrahedra: of its mesh.
        force: relative error of the force of the motion.
        field: L2 norm of the difference of displacements over that of the reference's departure
            from rest.
    """

    tetrahedra: int
    force: float
    field: float


def settled(
    case: Case,
    mesh: TetMesh,
    nu: float,
    stiffening: float,
    *,
    model: ModelName = 'stiffening',
    tolerance: float = STRAIN_TOLERANCE,
) -> tuple[ElasticModel, Floats, float]:
    """Return the model, its displacement [m], shape (n, 3), and the force of the motion [J]."""
    material = Material(5400.0, nu, 1060.0, stiffening=stiffening)
    elastic = ElasticModel(mesh, material, model, tolerance)
    u = followed(case, elastic)
    return elastic, u, _force(case, elastic, u)


def followed(case: Case, elastic: ElasticModel) -> Floats:
    """Return the displacement of a model at the end of the motion [m], shape (n, 3).

    Raises:
        MeshError: no equilibrium was found on the way.
    """
    mesh, held = elastic.mesh, elastic.mesh.fixed == 1
    none = np.zeros_like(mesh.rest)
    done, u, part = 0.0, none, 1 / (2 * case.steps)
    rate = none  # of the displacement, by share of the load
    while done < 1 - 1e-9:
        share = min(done + part, 1.0)
        start = u + (share - done) * rate
        start = np.where(held[:, None], case.motion(mesh.rest, share), start)
        try:
            found = equilibrium(
                elastic, none, held=held, start=start, tolerance=1e-4, iterations=25
            )
        except MeshError:
            part /= 2
            if part < MIN_PART:
                raise
            continue
        rate = (found - u) / (share - done)
        done, u = share, found
    return u


def compared(
    case: Case, block: LawBlock, nu: float, edge: float, seed: int, model: ModelName = 'stiffening'
) -> LawError:
    """Return the error of a model on an unstructured mesh.

    Args:
        case: of the motion.
        block: its reference.
        nu: Poisson's ratio.
        edge: mean edge of the mesh [m].
        seed: of the mesh.
        model: name.
    """
    mesh = unstructured_block(case, edge, seed)
    elastic, u, _ = settled(case, mesh, nu, block.solid.stiffening, model=model)
    return errors_at(case, block, elastic, u)


def errors_at(case: Case, block: LawBlock, elastic: ElasticModel, u: Floats) -> LawError:
    """Return the error of a model at the end of the motion.

    Args:
        case: of the motion.
        block: its reference.
        elastic: the model.
        u: its displacement [m], shape (n, 3).
    """
    mesh = elastic.mesh
    right = block.at(mesh.rest)
    weight = elastic.mass[:, None]
    field = np.sqrt((weight * (u - right) ** 2).sum() / (weight * right**2).sum())
    exact = block.force(case.motion, 1.0)
    return LawError(len(mesh.tetrahedra), _force(case, elastic, u) / exact - 1, float(field))


def _force(case: Case, elastic: ElasticModel, u: Floats) -> float:
    """Return the force of the motion at its end [J]."""
    mesh, d = elastic.mesh, 1e-6
    rate = (case.motion(mesh.rest, 1 + d) - case.motion(mesh.rest, 1 - d)) / (2 * d)
    return float((elastic.force(u) * rate)[mesh.fixed == 1].sum())


def main() -> None:
    """Print the table: each case at both Poisson's ratios."""
    parser = argparse.ArgumentParser(prog='bench.accuracy.law_problems', description=main.__doc__)
    parser.add_argument('names', nargs='*', metavar='NAME', help=f'of {", ".join(CASES)}')
    names = parser.parse_args().names or list(CASES)
    for name in names:
        if name not in CASES:
            parser.error(f'there is no case {name!r}: there are {", ".join(CASES)}')
    print(f'b {STIFFENING:g}, against quadratic hexahedra; bounds: force 5 %, field 7 %\n')
    print(
        '| problem | nu | tetrahedra | force error | field error | CPU [s] | reference, CPU [s] |'
    )
    print('|---|---|---|---|---|---|---|', flush=True)
    for name in names:
        for nu in RATIOS:
            print(f'| {name} | {nu:g} | {_row(CASES[name], nu)} |', flush=True)


def _row(case: Case, nu: float) -> str:
    start = time.process_time()
    try:
        block = solved_reference(case, nu, STIFFENING, case.cells)
        middle = time.process_time()
        found = compared(case, block, nu, case.edge, SEED)
    except (SessionError, MeshError) as error:
        return f'none: {error} | | | |'
    errors = f'{100 * found.force:+.1f} % | {100 * found.field:.1f} %'
    cpu = f'{time.process_time() - middle:.0f} | {middle - start:.0f}'
    return f'{found.tetrahedra} | {errors} | {cpu}'


if __name__ == '__main__':
    main()
