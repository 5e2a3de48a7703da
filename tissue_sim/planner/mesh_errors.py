"""Errors of models and mesh, by loads on the scene's own mesh and on finer ones."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.refine import refined
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.planner.indentation import Indenter, places, settlement

if TYPE_CHECKING:
    from cutting_trainer.tissue_sim.planner.deep_indentation import DeepIndentation

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Strains:
    """Relative errors of the settlement by a model's strain, in an indentation of given depth.

    Each is computed on first use: a scene for a linear model needs no other.

    Attributes:
        mesh, material: the tissue.
        indenter: at the softest place.
        depth: of the indentation [m].
    """

    mesh: TetMesh
    material: Material
    indenter: Indenter
    depth: float

    @cached_property
    def linear(self) -> float:
        """Error of models without rotations [-]; infinite if the tissue collapses before."""
        return self._error(rotating=False)

    @cached_property
    def rotating(self) -> float:
        """Error of models with rotations [-]; infinite if they or the tissue collapse."""
        return self._error(rotating=True)

    @property
    def steepness(self) -> float:
        """Depth of the indentation over its radius [-]; infinite if the tissue collapses before."""
        return self._deep_indentation.steepness if self._deep_indentation else float('inf')

    def _error(self, *, rotating: bool) -> float:
        return self._deep_indentation.error(rotating) if self._deep_indentation else float('inf')

    @cached_property
    def _deep_indentation(self) -> 'DeepIndentation | None':
        from cutting_trainer.tissue_sim.planner.deep_indentation import (
            indent,  # imports scipy's sparse matrices, which few scenes need
        )

        try:
            return indent(self.mesh, self.material, self.indenter, self.depth)
        except MeshError:
            return None


@dataclass(frozen=True)
class Probing:
    """Results of the trial loads.

    Attributes:
        elements: largest relative error of the settlement by element size, for plain and for
            smoothed elements [-].
        strains: errors at the required depth.
        frequency: upper bound of the slowest motion excited by a load [rad/s].
    """

    elements: dict[bool, float]
    strains: Strains
    frequency: float


def probe(mesh: TetMesh, material: Material, radius: float, displacement: float) -> Probing:
    """Load a tissue at some places.

    Args:
        mesh: the tissue.
        material: its constants.
        radius: of the area that a tool loads [m].
        displacement: required depth [m].
    """
    fine = refined(mesh)
    names: dict[bool, ModelName] = {False: 'linear', True: 'linear_smoothed'}
    here = {smoothed: ElasticModel(mesh, material, name) for smoothed, name in names.items()}
    there = {smoothed: ElasticModel(fine, material, name) for smoothed, name in names.items()}
    errors: dict[bool, list[float]] = {False: [], True: []}
    indenters = places(mesh, radius)
    softest, most, slowest = indenters[0], 0.0, np.inf
    for indenter in indenters:
        load, finer = indenter.load(mesh), indenter.load(fine)
        coarse = {smoothed: settlement(model, load) for smoothed, model in here.items()}
        half = {smoothed: settlement(model, finer)[0] for smoothed, model in there.items()}
        # Both converge to one value: plain elements from below, smoothed ones much closer.
        limits = [half[s] + (half[s] - coarse[s][0]) / 3 for s in names]
        for smoothed in names:
            value = coarse[smoothed][0]
            errors[smoothed].append(max(abs(value / limit - 1) for limit in limits))
        value, u = coarse[True]
        if value > most:
            softest, most = indenter, value
        inertia = float(here[True].mass @ np.square(u).sum(axis=1))
        slowest = min(slowest, float(np.sqrt(value / inertia)))
    return Probing(
        {smoothed: max(found) for smoothed, found in errors.items()},
        Strains(mesh, material, softest, displacement),
        slowest,
    )
