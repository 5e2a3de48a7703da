"""How far models and mesh are wrong: loads on the scene's own mesh, and on finer ones."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tissue_sim.elasticity import ElasticModel, ModelName
from tissue_sim.errors import MeshError
from tissue_sim.material import Material
from tissue_sim.mesh import TetMesh
from tissue_sim.press import Press, places, settlement
from tissue_sim.refine import refined

if TYPE_CHECKING:
    from tissue_sim.dent import Dents

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Strains:
    """Relative errors of the settlement by a model's strain, in a dent as deep as asked.

    Each is computed when it is asked for: a scene that a linear model serves needs no other.

    Attributes:
        mesh, material: the tissue.
        press: where it yields most.
        depth: how deep [m].
    """

    mesh: TetMesh
    material: Material
    press: Press
    depth: float

    @cached_property
    def linear(self) -> float:
        """Of models whose elements do not turn [-]; infinite where the tissue gives way before."""
        return self._error(rotating=False)

    @cached_property
    def rotating(self) -> float:
        """Of models whose elements turn [-]; infinite where they or the tissue give way."""
        return self._error(rotating=True)

    @property
    def steepness(self) -> float:
        """Depth of the dent over its radius [-]; infinite where the tissue gives way before."""
        return self._dents.steepness if self._dents else float('inf')

    def _error(self, *, rotating: bool) -> float:
        return self._dents.error(rotating) if self._dents else float('inf')

    @cached_property
    def _dents(self) -> 'Dents | None':
        from tissue_sim.dent import dents  # and scipy's sparse matrices, which few scenes need

        try:
            return dents(self.mesh, self.material, self.press, self.depth)
        except MeshError:
            return None


@dataclass(frozen=True)
class Probing:
    """What the loads came to.

    Attributes:
        elements: largest relative error of the settlement by the size of the elements, of plain
            and of smoothed ones [-].
        strains: errors at the depth that was asked for.
        frequency: of the slowest motion that a load excites [rad/s], at most.
    """

    elements: dict[bool, float]
    strains: Strains
    frequency: float


def probe(mesh: TetMesh, material: Material, radius: float, displacement: float) -> Probing:
    """Presses a tissue at some places.

    Args:
        mesh: the tissue.
        material: its constants.
        radius: of the area that a tool loads [m].
        displacement: how deep it goes [m].
    """
    fine = refined(mesh)
    names: dict[bool, ModelName] = {False: 'linear', True: 'linear_smoothed'}
    here = {smoothed: ElasticModel(mesh, material, name) for smoothed, name in names.items()}
    there = {smoothed: ElasticModel(fine, material, name) for smoothed, name in names.items()}
    errors: dict[bool, list[float]] = {False: [], True: []}
    presses = places(mesh, radius)
    softest, most, slowest = presses[0], 0.0, np.inf
    for press in presses:
        load, finer = press.load(mesh), press.load(fine)
        coarse = {smoothed: settlement(model, load) for smoothed, model in here.items()}
        half = {smoothed: settlement(model, finer)[0] for smoothed, model in there.items()}
        # Both converge to the same: plain elements from below, smoothed ones nearer by far.
        limits = [half[s] + (half[s] - coarse[s][0]) / 3 for s in names]
        for smoothed in names:
            value = coarse[smoothed][0]
            errors[smoothed].append(max(abs(value / limit - 1) for limit in limits))
        value, u = coarse[True]
        if value > most:
            softest, most = press, value
        inertia = float(here[True].mass @ np.square(u).sum(axis=1))
        slowest = min(slowest, float(np.sqrt(value / inertia)))
    return Probing(
        {smoothed: max(found) for smoothed, found in errors.items()},
        Strains(mesh, material, softest, displacement),
        slowest,
    )
