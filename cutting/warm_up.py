"""Warm-up: calls every kernel of cutting once, so that none is compiled or loaded in a stroke."""

from itertools import pairwise

import numpy as np

from cutting_trainer.cutting.lookup import edge_key, empty_tables, find_edge, with_room
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.parting import part_along
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.state_table import block, put_on_cut
from cutting_trainer.cutting.swept_surface import Surface
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta
from cutting_trainer.tissue_sim.warm_up import small_cube

_MANY_EDGES = 1 << 12
"""More than an empty table has room for: it is made anew."""


def warm_up(settings: CuttingSettings) -> None:
    """Cut a cube with the method of some settings, and part another."""
    warm_up_method(settings)
    warm_up_parting()


def warm_up_method(settings: CuttingSettings) -> None:
    """Move a blade through a cube with the method of some settings."""
    mesh = small_cube()
    method = make_method(settings)
    x = np.array([-0.001, 0.004, 0.007, 0.011])
    for before, after in pairwise(x):
        edge = [np.array([at, 0.0052, z]) for at in (before, after) for z in (0.012, 0.004)]
        result = method.advance(mesh, mesh.rest, Sweep(*edge))
        if not result.delta.empty:
            mesh.apply(result.delta)
    method.finish(mesh, mesh.rest)
    # Of elements that are too flat to be divided or would be inside out: the cube has none.
    room = {'mesh_nodes': 1, 'tetrahedra': 1, 'nodes': 1, 'edges': _MANY_EDGES, 'parents': 1}
    tables = with_room(empty_tables(), **room)
    put_on_cut(tables, 0, np.zeros(0, np.int64), mesh.rest)
    block(tables, 0, np.zeros(0, np.int64))
    ends = np.int64(0), np.int64(1)
    find_edge(tables, *ends)
    edge_key(*ends)


def warm_up_parting() -> None:
    """Part a cube along its middle, as strokes do that leave tissue between them."""
    mesh = small_cube()
    size, middle = float(np.ptp(mesh.rest)), mesh.rest.mean(axis=0)
    share = np.linspace(-0.6, 0.6, 13)
    points = middle + size * np.stack(np.meshgrid(0.0, share, share), axis=-1).reshape(-1, 3)
    normals = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    line = middle + size * np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])
    nodes = np.arange(mesh.node_count)
    part_along(mesh, TopologyDelta(), nodes, Surface(points, normals), line[None], 0.5 * size)
