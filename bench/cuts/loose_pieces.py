"""Pieces cut free: told once, and at rest soon: `python -m bench.cuts.loose_pieces`.

Their number and volumes are counted by the closed surfaces of the mesh, which trimesh splits and
integrates; the volume is compared with that of the cut's own shape, too.
"""

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from bench.cuts.curves import (
    Cut,
    Organ,
    circle,
    four_arcs,
    four_lines,
    liver,
    scattered,
    slab,
)
from bench.cuts.strokes import results_along
from cutting_trainer.cutting.method_interface import CutMethod
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.pieces import Piece, PieceRegister, free_parts
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

Floats = NDArray[np.float64]

PUSH = 0.2
"""Speed that a tool leaves a piece with [m/s]."""
SPIN = 10.0
"""And its rate of rotation [1/s]."""
AT_REST = 1e-4
"""Speed below which it is at rest [m/s]."""
FRAMES = 60
"""In two seconds."""
_STEP = 0.15
_SMALL = 0.02
"""Pieces of less than this share of the cut's volume are crumbs."""

SCENES = ('block', 'liver', 'flap')


@dataclass(frozen=True)
class Outcome:
    """A cut around a piece.

    Attributes:
        name: of mesh and cut.
        free: trimesh finds a piece of the cut's size.
        told: pieces told, without crumbs.
        again: pieces told again, or told and not found.
        crumbs: further pieces told.
        unsaid: crumbs that trimesh finds, and nobody told.
        off: largest relative error of a told volume against trimesh's.
        shape: relative error of the piece's volume against the cut's shape; NaN: not known.
        rest: time until the piece is at rest [s]; infinite: not within two seconds.
        moving: nodes that are moved after two seconds.
    """

    name: str
    free: bool
    told: int
    again: int
    crumbs: int
    unsaid: int
    off: float
    shape: float
    rest: float
    moving: int


def counted(mesh: TetMesh) -> dict[int, float]:
    """Return the volumes of the pieces without a fixed node [m^3], by their first nodes."""
    surface = trimesh.Trimesh(mesh.rest, mesh.triangles, process=False)
    groups = trimesh.graph.connected_components(
        surface.edges_unique, nodes=np.unique(surface.faces)
    )
    of = np.full(mesh.node_count, -1)
    for k, nodes in enumerate(groups):
        of[nodes] = k
    held = set(of[mesh.fixed == 1].tolist())
    found = {}
    for k, nodes in enumerate(groups):
        if k not in held:
            part = surface.submesh([np.flatnonzero(of[surface.faces[:, 0]] == k)], append=True)
            found[int(nodes.min())] = float(part.volume)
    return found


def cap(organ: Organ, rng: np.random.Generator) -> Cut:
    """Return a flat cut that takes the top off, some twentieths of the tissue."""
    normal = np.array([*rng.uniform(-0.35, 0.35, 2), 1.0])
    normal /= np.linalg.norm(normal)
    height = organ.nodes @ normal
    at = float(np.quantile(height, rng.uniform(0.80, 0.93)))
    one = np.cross(normal, [0.0, 1.0, 0.0])
    one /= np.linalg.norm(one)
    two = np.cross(normal, one)
    taken = organ.nodes[height > at - organ.h]
    reach = [taken @ axis for axis in (one, two)]
    if np.ptp(reach[0]) > np.ptp(reach[1]):
        one, two, reach = two, one, reach[::-1]
    ends = [(r.min() - organ.h, r.max() + organ.h) for r in reach]
    way = np.arange(ends[1][0], ends[1][1], _STEP * organ.h)
    path = np.stack([at * normal + e * one + way[:, None] * two for e in ends[0]], axis=1)
    return Cut((path,), inside=at * normal)


def _upward(cut: Cut) -> Floats:
    """Return the unit normal of a flat cut, shape (3,)."""
    a, b, c = cut.paths[0][0, 0], cut.paths[0][0, 1], cut.paths[0][-1, 0]
    normal: Floats = np.cross(b - a, c - a)
    return normal * math.copysign(1.0, normal[2]) / np.linalg.norm(normal)


def volume_of(organ: Organ, cut: Cut, name: str) -> float:
    """Return the volume that a cut's shape takes from a mesh [m^3]; NaN: not known."""
    if name == 'cap':
        mesh = TetMesh(organ.nodes, organ.tetrahedra)
        surface = trimesh.Trimesh(mesh.rest, mesh.triangles, process=False)
        a = cut.paths[0][0, 0]
        nodes, faces, _ = trimesh.intersections.slice_faces_plane(
            surface.vertices, surface.faces, _upward(cut), a
        )
        # Seen from a point of the plane, the missing face of the cut has no volume.
        return float(np.linalg.det(nodes[faces] - a).sum()) / 6
    if organ.name != 'slab':
        return math.nan
    area = 4.0 if name == 'four lines' else math.pi
    return area * cut.radius**2 * float(np.ptp(organ.nodes[:, 2]))


CUTS: dict[str, Callable[[Organ, np.random.Generator], Cut]] = {
    'circle': lambda organ, rng: circle(organ, rng.uniform(2, 4), rng),
    'four arcs': lambda organ, rng: four_arcs(organ, rng.uniform(2, 4), rng),
    'four lines': lambda organ, rng: four_lines(organ, rng.uniform(2, 4), rng),
    'cap': cap,
}


def simulation_of(organ: Organ, scene: str, cut: Cut, name: str) -> TissueSimulation:
    """Return a mesh as tissue of a shipped scene, held where the cut does not go."""
    tissue = load_scene(scene).tissue
    m, d, i = tissue.material, tissue.damping, tissue.integration
    material = Material(
        m.youngs_modulus, m.poissons_ratio, m.density, d.alpha, d.beta, m.stiffening, m.prony
    )
    if name == 'cap':
        height = organ.nodes @ _upward(cut)
        fixed = height < np.quantile(height, 0.2)
    else:
        away = np.linalg.norm((organ.nodes - cut.inside)[:, :2], axis=1)
        fixed = away > min(cut.beyond + 0.5 * organ.h, float(np.quantile(away, 0.99)))
    return TissueSimulation(
        TetMesh(organ.nodes.copy(), organ.tetrahedra.copy(), fixed.astype(np.uint8)),
        material,
        Resistance(tissue.cut_threshold, m.toughness, m.blade_friction),
        model=tissue.model,
        stepping=TimeStepping(
            tissue.integrator,
            safety=i.safety,
            max_substeps=i.max_substeps,
            frequency_growth=i.frequency_growth,
        ),
        active=ActiveSettings('on'),
    )


def draw(simulation: TissueSimulation, path: Floats, cutter: CutMethod) -> None:
    """Move a blade along a path through the tissue as it stands."""
    for result in results_along(cutter, simulation.mesh, path, lambda: simulation.positions):
        if not result.delta.empty:
            simulation.apply_cut(result.delta)


def take_out(organ: Organ, name: str, scene: str, seed: int) -> Outcome:
    """Cut a piece out of a mesh, push it away, and follow it for two seconds."""
    rng = np.random.default_rng(seed)
    cut = CUTS[name](organ, rng)
    simulation = simulation_of(organ, scene, cut, name)
    mesh = simulation.mesh
    register = PieceRegister(mesh)
    cutter = make_method(CuttingSettings())
    told: list[Piece] = []
    for path in cut.paths:
        draw(simulation, path, cutter)
        told += register.find_new(mesh, simulation.positions)
    found = counted(mesh)
    again = len(register.find_new(mesh, simulation.positions))
    again += len(told) - len({piece.number for piece in told})
    sizes = sorted(found.values(), reverse=True)
    said = sorted((piece.volume for piece in told), reverse=True)
    pairs = list(zip(said, sizes, strict=False))
    off = max((abs(a / b - 1) for a, b in pairs), default=0.0)
    shape = volume_of(organ, cut, name)
    least = _SMALL * (sizes[0] if sizes else math.inf)
    rest, moving = _follow(simulation, rng)
    return Outcome(
        f'{organ.name}, {name}, {scene}',
        bool(sizes),
        sum(size >= least for size in said),
        again + max(len(said) - len(sizes), 0),
        sum(size < least for size in said),
        max(len(sizes) - len(said), 0),
        off,
        sizes[0] / shape - 1 if sizes and not math.isnan(shape) else math.nan,
        rest,
        moving,
    )


def _follow(simulation: TissueSimulation, rng: np.random.Generator) -> tuple[float, int]:
    """Push all loose tissue; return when it is at rest [s], and how many nodes move at the end."""
    part = free_parts(simulation.mesh)
    velocity = simulation.velocity
    for p in range(1, int(part.max(initial=0)) + 1):
        own = np.flatnonzero(part == p)
        way = rng.normal(size=3)
        away = simulation.positions[own] - simulation.positions[own].mean(axis=0)
        velocity[own] = PUSH * way / np.linalg.norm(way) + np.cross(SPIN * rng.normal(size=3), away)
    simulation.dynamics.restart()
    loose = part > 0
    last = 0
    for frame in range(1, FRAMES + 1):
        simulation.frame(None)
        if float(np.abs(simulation.velocity[loose]).max(initial=0.0)) > AT_REST:
            last = frame
    rest = math.inf if last == FRAMES else last / simulation.dynamics.stepping.rate
    return rest, simulation.dynamics.active_nodes


def _is_good(run: Outcome) -> bool:
    """Return whether one piece is free and was told once, beside crumbs."""
    return run.free and run.told == 1 and not (run.again or run.unsaid)


def main() -> None:
    """Cut pieces out of tissues, and print how they were told and when they were at rest."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument('--pieces', type=int, default=200)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    organs = [slab((14, 14, 3)), liver(), scattered()]
    runs = []
    for k in range(options.pieces):
        organ = organs[k % len(organs)]
        name = list(CUTS)[k // len(organs) % len(CUTS)]
        run = take_out(organ, name, SCENES[k // 12 % len(SCENES)], options.seed + k)
        runs.append(run)
        if not _is_good(run) or run.off > 0.01 or run.rest > 2:
            print(run, flush=True)
    good = sum(map(_is_good, runs))
    shapes = np.abs([run.shape for run in runs if not math.isnan(run.shape)])
    rests = [run.rest for run in runs]
    print(f'{len(runs)} cuts, {good} with one piece told once')
    print(f'told besides: {sum(run.crumbs for run in runs)} crumbs')
    print(f'volume off by {max(run.off for run in runs):.1e} at most')
    print(
        f'shape of the cut off by {np.median(shapes):.1e}, {np.quantile(shapes, 0.95):.1e}, '
        f'{shapes.max():.1e} (median, p95, most of {len(shapes)})'
    )
    print(f'at rest after {np.median(rests):.2f}, {max(rests):.2f} s (median, most)')
    print(f'nodes moved after two seconds in {sum(run.moving > 0 for run in runs)}')
    sys.exit(good < len(runs))


if __name__ == '__main__':
    main()
