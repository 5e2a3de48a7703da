"""Which nodes move."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from tissue_sim.coupling import Coupling
from tissue_sim.elasticity import ElasticModel, Operands


@dataclass(frozen=True)
class ActiveSettings:
    """How the active region is chosen."""

    mode: Literal['off', 'on', 'budget'] = 'off'
    nodes: int = 1000


class Region(NamedTuple):
    """Intervals of nodes that move, shape (s, 2), and the operands that they need."""

    spans: np.ndarray
    operands: Operands


class ActiveRegion:
    """Chooses."""

    def __init__(self, model: ElasticModel, settings: ActiveSettings) -> None:
        self._model = model
        self._settings = settings

    @property
    def count(self) -> int:
        """Nodes that move."""
        return self._model.mesh.node_count

    def blocks(self, substeps: int) -> list[int]:
        """Substeps between two choices."""
        return [substeps]

    def choose(
        self,
        u: np.ndarray,
        v: np.ndarray,
        inverse_mass: np.ndarray,
        coupling: Coupling,
        seconds: float,
    ) -> Region:
        """All nodes."""
        n = self._model.mesh.node_count
        return Region(np.array([[0, n]]), self._model.operands())

    def follow_cut(self, nodes: np.ndarray) -> None:
        """Nothing."""
