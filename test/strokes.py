"""Blades drawn through meshes, for the tests of cutting."""

from itertools import pairwise

import numpy as np

from cutting_trainer.cutting.cut_invariants import check_mesh, cut_faces
from cutting_trainer.cutting.method_interface import CutResult
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh


def method_named(name='combined', **settings):
    return make_method(CuttingSettings(method=name, **settings))


def straight(begin, end, edge, steps):
    """Root and tip of a blade that moves from `begin` to `end`, with the tip at those points."""
    way = np.linspace(begin, end, steps + 1)
    return np.stack([way + np.asarray(edge, float), way], axis=1)


def draw(method, mesh, path, *, positions=None, finish=True) -> list[CutResult]:
    """Draws the blade along a path, shape (k, 2, 3), and checks the mesh after every batch."""
    volume = float(mesh.volumes().sum())
    old = cut_faces(mesh)
    results = []

    def take(result):
        nonlocal volume
        results.append(result)
        volume -= result.report.removed_volume
        if not result.delta.empty:
            mesh.apply(result.delta)
            if result.report.removed_volume == 0.0:
                check_mesh(mesh, volume, old)

    where = positions or (lambda mesh: mesh.rest)
    for before, after in pairwise(path):
        take(method.advance(mesh, where(mesh), Sweep(before[0], before[1], after[0], after[1])))
    if finish:
        take(method.finish(mesh, where(mesh)))
    return results


def total_cases(results):
    return sum(result.report.cases for result in results)


def total_area(results):
    return sum(result.report.area for result in results)


def mesh_of(nodes, tets, fixed=None) -> TetMesh:
    return TetMesh(nodes, tets, fixed)
