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
from cutting_trainer.tissue_sim.planner.contact_errors import contact_error
from cutting_trainer.tissue_sim.planner.indentation import (
    Indenter,
    places,
    settlement,
    surroundings,
)

if TYPE_CHECKING:
    from cutting_trainer.tissue_sim.planner.deep_indentation import DeepIndentation, StrainName

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

    def error(self, model: ModelName, enough: float = np.inf) -> float:
        """Return the error of a model [-]; infinite if it or the tissue collapses.

        Args:
            model: which one.
            enough: see `DeepIndentation.error`.
        """
        strains: StrainName = 'law' if model == 'stiffening' else 'linear'
        if model.startswith('corotational'):
            strains = 'rotating'
        if strains not in self._found:
            deep = self._deep_indentation
            self._found[strains] = deep.error(strains, enough) if deep else float('inf')
        return self._found[strains]

    @property
    def steepness(self) -> float:
        """Depth of the indentation over its radius [-]; infinite if the tissue collapses before."""
        return self._deep_indentation.steepness if self._deep_indentation else float('inf')

    @cached_property
    def _found(self) -> dict['StrainName', float]:
        return {}

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
        contact: largest relative error of a tool's depth by its footprint [-].
        strains: errors at the required depth.
        settled: settlement at the softest place, by force [m/N].
        frequency: upper bound of the slowest motion excited by a load [rad/s].
    """

    elements: dict[bool, float]
    contact: float
    strains: Strains
    settled: float
    frequency: float


def probe(mesh: TetMesh, material: Material, radius: float, displacement: float) -> Probing:
    """Load a tissue at some places.

    Args:
        mesh: the tissue.
        material: its constants.
        radius: of the area that a tool loads [m].
        displacement: required depth [m].
    """
    names: dict[bool, ModelName] = {False: 'linear', True: 'linear_smoothed'}
    whole = ElasticModel(mesh, material, 'linear_smoothed')
    errors: dict[bool, list[float]] = {False: [], True: []}
    indenters = places(mesh, radius)
    softest, most, slowest, contact = indenters[0], 0.0, np.inf, 0.0
    near, fine = mesh, mesh
    for indenter in indenters:
        if fine is mesh or near is not mesh:  # a small mesh is refined once
            near = surroundings(mesh, indenter)
            fine = refined(near)
            here = {s: ElasticModel(near, material, name) for s, name in names.items()}
            there = {s: ElasticModel(fine, material, name) for s, name in names.items()}
        load, finer = indenter.load(near), indenter.load(fine)
        coarse = {smoothed: settlement(model, load)[0] for smoothed, model in here.items()}
        half = {smoothed: settlement(model, finer)[0] for smoothed, model in there.items()}
        # Both converge to one value: plain elements from below, smoothed ones much closer.
        limits = [half[s] + (half[s] - coarse[s]) / 3 for s in names]
        for smoothed in names:
            value = coarse[smoothed]
            errors[smoothed].append(max(abs(value / limit - 1) for limit in limits))
        value, u = settlement(whole, indenter.load(mesh))
        if value > most:
            softest, most = indenter, value
        inertia = float(whole.mass @ np.square(u).sum(axis=1))
        slowest = min(slowest, float(np.sqrt(value / inertia)))
        contact = max(contact, contact_error(mesh, material, indenter, displacement))
    return Probing(
        {smoothed: max(found) for smoothed, found in errors.items()},
        contact,
        Strains(mesh, material, softest, displacement),
        most,
        slowest,
    )
