"""What the models get wrong in a deep dent: each held against a neo-Hookean tissue there.

A dent no wider than an element is not seen by the scene's own mesh, nor is the bending of the
whole seen from near. So both are looked at: the whole tissue on its mesh, and the elements nearest
to the tool, as they are and each split into eight. What splitting them changes is not over with
once: elements twice as small yield more in a dent, those twice as small again more still.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tissue_sim.compliance import solve_static
from tissue_sim.elasticity import ElasticModel, ModelName
from tissue_sim.equilibrium import equilibrium, preconditioner
from tissue_sim.errors import MeshError
from tissue_sim.hyperelastic import NeoHookean, smoothed_points
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.press import Press, settlement
from tissue_sim.refine import refined

Floats = NDArray[np.float64]

_WIDE = 3.0
"""Radii of a press that its surroundings reach, if they do not have too many elements."""
_NEAR = 500
"""Elements that surroundings have at most, before they are split."""
_STEPS = (4, 12)
"""Parts that a depth is reached in: at first, and if there is no equilibrium that way."""


@dataclass(frozen=True)
class Dent:
    """A press as deep as asked, on one mesh.

    Attributes:
        mesh, material: the tissue, or a part of it.
        load: of 1 N [N], shape (n, 3).
        depth: of the neo-Hookean tissue [m].
        force: that it takes [N].
        part: of the whole settlement that this depth is [-].
    """

    mesh: TetMesh
    material: Material
    load: Floats
    depth: float
    force: float
    part: float

    def error(self, rotating: bool) -> float:
        """Relative error of the settlement by a model's strain, signed; infinite: it gives way.

        Args:
            rotating: whether the model's elements turn. Smoothed ones stand for plain ones.
        """
        name: ModelName = 'corotational_smoothed' if rotating else 'linear_smoothed'
        model = ElasticModel(self.mesh, self.material, name)
        load = self.force * self.load
        if not rotating:
            return self._error(solve_static(model, _free(self.mesh), load, 1e-6))
        u = np.zeros_like(load)
        try:
            for share in (0.25, 0.5, 0.75, 1.0):
                u = equilibrium(model, share * load, start=u, tolerance=1e-4, iterations=25)
        except MeshError:
            return float('inf')
        return self._error(u)

    def _error(self, u: Floats) -> float:
        return self.part * (float(np.sum(self.load * u)) / self.depth - 1)


@dataclass(frozen=True)
class Dents:
    """The same press on the whole tissue and near it.

    Attributes:
        whole: on the mesh of the scene.
        near, finer: of the elements around the press, and of those each split into eight.
        steepness: depth of the dent itself, without what the whole yields, over its radius [-].
    """

    whole: Dent
    near: Dent
    finer: Dent
    steepness: float

    def error(self, rotating: bool) -> float:
        """Largest relative error of the settlement by a model's strain; infinite: it gives way.

        On the mesh as it is, with what finer elements near the press change, and in the limit, for
        which a change that halves with the size of the elements is as large again.

        Args:
            rotating: whether the model's elements turn.
        """
        here = self.whole.error(rotating)
        change = self.finer.error(rotating) - self.near.error(rotating)
        largest = max(abs(here), abs(here + change), abs(here + 2 * change))
        return largest if np.isfinite(largest) else float('inf')


def dents(mesh: TetMesh, material: Material, press: Press, depth: float) -> Dents:
    """Presses the whole tissue, and the surroundings of the press.

    Args:
        mesh: the tissue.
        material: its constants.
        press: where and how wide.
        depth: how deep [m].

    Raises:
        MeshError: there is no equilibrium as deep as that.
    """
    around = surroundings(mesh, press)
    meshes = (mesh, around, refined(around))
    soft = [
        settlement(ElasticModel(part, material, 'linear_smoothed'), press.load(part))[0]
        for part in meshes
    ]
    parts = [min(value / soft[0], 1.0) for value in soft]
    whole, near, finer = (
        _dent(m, material, press, depth, p) for m, p in zip(meshes, parts, strict=True)
    )
    return Dents(whole, near, finer, parts[2] * depth / press.radius)


def _dent(mesh: TetMesh, material: Material, press: Press, depth: float, part: float) -> Dent:
    load, deep = press.load(mesh), part * depth
    free = _free(mesh)
    rest = np.zeros(3 * mesh.node_count)
    solve = preconditioner(ElasticModel(mesh, material, 'linear'), rest, free)
    tissue = NeoHookean(smoothed_points(mesh, material), free, solve)
    for steps in _STEPS:
        try:
            force, _ = tissue.press(load.ravel(), deep, steps)
        except MeshError:
            if steps == _STEPS[-1]:
                raise
        else:
            break
    return Dent(mesh, material, load, deep, force, part)


def _free(mesh: TetMesh) -> NDArray[np.bool_]:
    return np.repeat(mesh.fixed == 0, 3)


def surroundings(mesh: TetMesh, press: Press) -> TetMesh:
    """The elements around a press, fixed where others were.

    Args:
        mesh: the whole.
        press: in the middle of what is kept.
    """
    middles = mesh.rest[mesh.tetrahedra].mean(axis=1)
    away = np.linalg.norm(middles - press.centre, axis=1)
    most = np.partition(away, _NEAR - 1)[_NEAR - 1] if len(away) > _NEAR else np.inf
    kept = away <= min(_WIDE * press.radius, max(most, 1.5 * press.radius))
    held = mesh.fixed.copy()
    held[mesh.tetrahedra[~kept].ravel()] = 1
    nodes, tetrahedra = np.unique(mesh.tetrahedra[kept].astype(np.int64), return_inverse=True)
    return TetMesh(mesh.rest[nodes], tetrahedra.reshape(-1, 4), held[nodes])
