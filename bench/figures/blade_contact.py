"""Figures of the faces of a cut: they meet, carry compression, and carry no tension."""

import numpy as np
import trimesh

from bench.cuts.strokes import good_block, results_along
from bench.figures.figure import Figure
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.checks import EDGES, components
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.frame_motion import FrameMotion
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

_MATERIAL = Material(10000.0, 0.45, 1000.0, 15.0, 2e-4)
_STRAIN = 0.05
_SEEDS = (100, 101, 102, 103, 104)


def measure() -> list[Figure]:
    """Return the figures of line 6."""
    deepest, carried, pulled = [], [], []
    for seed in _SEEDS:
        whole, cut = slab('straight', 0.0, seed=seed, cut=False), slab('straight', 0.0, seed=seed)
        expected = reaction(whole, pressed(whole, _STRAIN))
        carried.append(abs(reaction(cut, pressed(cut, _STRAIN)) / expected - 1))
        deepest.append(1e3 * overlap(cut.mesh, cut.positions))
        pulled.append(abs(reaction(cut, pressed(cut, -_STRAIN)) / expected))
    count, name = len(_SEEDS), 'depth of one cut face in the other at 5 % compression, largest'
    carries = 'compression that a closed cut carries over that of uncut tissue, off 1'
    return [
        Figure(6, name, max(deepest), 0.1, 'at most', 'mm', count),
        *(
            Figure(6, f'the same, {shape}, friction {mu:g}', _deepest(shape, mu), 0.1, 'at most',
                   'mm', count)
            for shape, mu in (('inclined', 0.0), ('wave', 0.3))
        ),
        Figure(6, carries, max(carried), 0.02, 'at most', '', count),
        Figure(6, 'tension over that compression', max(pulled), 1e-3, 'at most', '', count),
    ]  # fmt: skip


def _deepest(shape: str, friction: float) -> float:
    """Return the largest depth of one cut face in the other, of all meshes [mm]."""
    cuts = [slab(shape, friction, seed=seed) for seed in _SEEDS]
    for cut in cuts:
        pressed(cut, _STRAIN)
    return max(1e3 * overlap(cut.mesh, cut.positions) for cut in cuts)


def slab(shape: str, friction: float, *, seed: int = 3, cut: bool = True) -> Dynamics:
    """Return a block held at its ends, which a blade has cut through.

    Args:
        shape: of the cut: straight, inclined or wave.
        friction: of the cut faces.
        seed: of the mesh.
        cut: whether it is cut.
    """
    nodes, tets = good_block((8, 4, 3), 0.005, seed=seed)
    (length, width, height), x = nodes.max(axis=0), nodes[:, 0]
    mesh = TetMesh(nodes, tets, (x < 1e-9) | (x > length - 1e-9))
    stepping = TimeStepping('symplectic_euler', frequency_growth=1.1)
    dynamics = Dynamics(mesh, _MATERIAL, 'linear_smoothed', stepping, friction=friction)
    if cut:
        way = np.linspace(-0.2, 1.2, 40)
        at = length / 2 + (0.12 * width * np.sin(6 * way) if shape == 'wave' else 0 * way)
        tilt = 0.4 * height if shape == 'inclined' else 0.0
        path = [
            [[a - 0.2 * tilt, w * width, 1.2 * height], [a + 1.3 * tilt, w * width, -0.3 * height]]
            for a, w in zip(at, way, strict=True)
        ]
        method = make_method(CuttingSettings())
        for result in results_along(method, mesh, np.array(path)):
            if not result.delta.empty:
                dynamics.apply_cut(result.delta)
    return dynamics


def overlap(mesh: TetMesh, positions: np.ndarray) -> float:
    """Return the largest depth of a point of one of two pieces in the other [m].

    Points are nodes, middles of edges and of triangles of the surface.

    Args:
        mesh: of two pieces.
        positions: of the nodes [m], shape (n, 3).

    Raises:
        ValueError: there are not two pieces.
    """
    count, piece = components(mesh.node_count, mesh.tetrahedra[:, EDGES].reshape(-1, 2))
    if count != 2:
        raise ValueError(f'the cut leaves {count} pieces')
    deepest = 0.0
    for k in range(count):
        own = piece[mesh.triangles[:, 0]] == k
        corners = positions[mesh.triangles[~own]]
        points = [corners.reshape(-1, 3), corners.mean(axis=1)]
        points += [(corners[:, i] + corners[:, i - 1]) / 2 for i in range(3)]
        tets = positions[mesh.tetrahedra[piece[mesh.tetrahedra[:, 0]] == k]]
        inverse = np.linalg.inv((tets[:, 1:] - tets[:, :1]).transpose(0, 2, 1))
        for point in np.unique(np.concatenate(points), axis=0):
            weights = np.einsum('tij,tj->ti', inverse, point - tets[:, 0])
            if (np.minimum(weights.min(axis=1), 1 - weights.sum(axis=1)) > 1e-6).any():
                surface = positions[mesh.triangles[own]]
                nearest = trimesh.triangles.closest_point(
                    surface, np.tile(point, (len(surface), 1))
                )
                deepest = max(deepest, float(np.linalg.norm(nearest - point, axis=1).min()))
    return deepest


def pressed(dynamics: Dynamics, strain: float, frames: int = 10, still: int = 20) -> FrameMotion:
    """Move the right end of a bar towards the other, and wait.

    Args:
        dynamics: a bar along x, held at its ends.
        strain: of the bar.
        frames: in which its end moves.
        still: in which it does not.

    Returns:
        The last frame.

    Raises:
        ValueError: a frame had an error.
    """
    x, fixed = dynamics.mesh.rest[:, 0], dynamics.mesh.fixed == 1
    right = fixed & (x > x.max() / 2)
    for k in range(frames + still):
        dynamics.displacement[right, 0] = -strain * x.max() * min((k + 1) / frames, 1.0)
        if k < frames:
            dynamics.restart()
        motion = dynamics.advance(Coupling())
        if motion.trouble:
            raise ValueError(motion.trouble)
    return motion


def reaction(dynamics: Dynamics, motion: FrameMotion) -> float:
    """Return the force of the right end on a bar, towards the left [N]."""
    x, fixed = dynamics.mesh.rest[:, 0], dynamics.mesh.fixed == 1
    return float(-motion.elastic_force[fixed & (x > x.max() / 2), 0].sum())
