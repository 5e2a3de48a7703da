"""Errors of the models under deep indentation, against a hyperelastic tissue.

The scene's own mesh does not resolve an indentation no wider than an element, and a small region
does not show the bending of the whole. Both are therefore computed: the tissue on its mesh, and the
elements nearest to the tool, as they are and each split into eight. One refinement does not
converge: elements of half the size yield more, and those of a quarter more still.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.compliance import solve_static
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium, preconditioner
from cutting_trainer.tissue_sim.elasticity.hyperelastic import Hyperelastic, smoothed_points
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import (
    STRAIN_TOLERANCE,
    ElasticModel,
    ModelName,
)
from cutting_trainer.tissue_sim.mesh.refine import refined
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.indentation import Indenter, settlement, surroundings

Floats = NDArray[np.float64]

StrainName = Literal['linear', 'rotating', 'law']
"""Strains of a model: linear ones, those of elements that rotate, those of a law."""

_WIDE = 3.0
"""Radius of the surrounding region, in radii of the indenter, unless it has too many elements."""
_NEAR = 500
"""Largest number of elements in the surroundings, before they are split."""
_NEWTON = 12
"""Newton steps for a part of the load, after which a model is said to give way."""
_STEPS = (4, 12)
"""Load steps to the depth: first attempt, and second if there is no equilibrium."""


@dataclass(frozen=True)
class MeshIndentation:
    """An indentation of given depth, on one mesh.

    Attributes:
        mesh, material: the tissue, or a part of it.
        load: of 1 N [N], shape (n, 3).
        depth: of the hyperelastic tissue [m].
        force: at that depth [N].
        moved: its displacement at that depth [m], shape (n, 3).
        part: ratio of this depth to the whole settlement [-].
    """

    mesh: TetMesh
    material: Material
    load: Floats
    depth: float
    force: float
    moved: Floats
    part: float

    def error(self, strains: StrainName) -> float:
        """Return the relative error of the settlement by a model's strain, signed; infinite if it
        collapses.

        Args:
            strains: of the model.
        """
        if strains == 'law':
            # To the first order: the work of the forces that it lacks, over that of the load.
            everywhere, blended = (
                ElasticModel(self.mesh, self.material, 'stiffening', tolerance).force(self.moved)
                for tolerance in (0.0, STRAIN_TOLERANCE)
            )
            lacking = float(np.sum((everywhere - blended) * self.moved))
            return self.part * lacking / (self.force * self.depth)
        rotating = strains == 'rotating'
        name: ModelName = 'corotational_smoothed' if rotating else 'linear_smoothed'
        model = ElasticModel(self.mesh, self.material, name)
        load = self.force * self.load
        if not rotating:
            return self._error(solve_static(model, _free(self.mesh), load, 1e-6))
        u = np.zeros_like(load)
        try:
            for share in (0.25, 0.5, 0.75, 1.0):
                u = equilibrium(model, share * load, start=u, tolerance=1e-3, iterations=_NEWTON)
        except MeshError:
            return float('inf')
        return self._error(u)

    def _error(self, u: Floats) -> float:
        return self.part * (float(np.sum(self.load * u)) / self.depth - 1)


@dataclass(frozen=True)
class DeepIndentation:
    """The same indentation of the whole tissue and of its surroundings.

    Attributes:
        whole: on the mesh of the scene, or the `WHOLE` elements nearest to the press.
        near, finer: of the elements around the press, and of those each split into eight.
        steepness: depth of the local indentation over its radius [-], without the deflection of the
            whole.
    """

    whole: MeshIndentation
    near: MeshIndentation
    finer: MeshIndentation
    steepness: float

    def error(self, strains: StrainName, enough: float = np.inf) -> float:
        """Return the largest relative error of the settlement by a model's strain; infinite if it
        collapses.

        It is computed on the present mesh, with the change by finer elements near the indenter, and
        in the limit: a change that halves with the element size is as large again.

        Args:
            strains: of the model.
            enough: error from which on that of the surroundings will do: the equilibrium of a model
                that gives way takes many seconds not to be found.
        """
        near = self.near.error(strains)
        if not abs(near) <= enough:
            return abs(near)
        here = self.whole.error(strains)
        if not np.isfinite(here):
            return float('inf')
        return self._largest(here, near, self.finer.error(strains))

    @staticmethod
    def _largest(here: float, near: float, finer: float) -> float:
        change = finer - near
        largest = max(abs(here), abs(here + change), abs(here + 2 * change))
        return largest if np.isfinite(largest) else float('inf')


def indent(mesh: TetMesh, material: Material, indenter: Indenter, depth: float) -> DeepIndentation:
    """Indent the whole tissue, and the surroundings of the indenter.

    Args:
        mesh: the tissue.
        material: its constants.
        indenter: place and radius.
        depth: of the indentation [m].

    Raises:
        MeshError: there is no equilibrium at that depth.
    """
    around = surroundings(mesh, indenter, _WIDE * indenter.radius, _NEAR)
    meshes = (surroundings(mesh, indenter), around, refined(around))
    soft = [
        settlement(ElasticModel(part, material, 'linear_smoothed'), indenter.load(part))[0]
        for part in (mesh, *meshes[1:])
    ]
    parts = [min(value / soft[0], 1.0) for value in soft]
    whole, near, finer = (
        _indent(m, material, indenter, depth, p) for m, p in zip(meshes, parts, strict=True)
    )
    return DeepIndentation(whole, near, finer, parts[2] * depth / indenter.radius)


def _indent(
    mesh: TetMesh, material: Material, indenter: Indenter, depth: float, part: float
) -> MeshIndentation:
    load, deep = indenter.load(mesh), part * depth
    free = _free(mesh)
    rest = np.zeros(3 * mesh.node_count)
    solve = preconditioner(ElasticModel(mesh, material, 'linear'), rest, free)
    tissue = Hyperelastic(smoothed_points(mesh, material), free, solve)
    for steps in _STEPS:
        try:
            force, moved = tissue.press(load.ravel(), deep, steps)
        except MeshError:
            if steps == _STEPS[-1]:
                raise
        else:
            break
    return MeshIndentation(mesh, material, load, deep, force, moved.reshape(-1, 3), part)


def _free(mesh: TetMesh) -> NDArray[np.bool_]:
    return np.repeat(mesh.fixed == 0, 3)
