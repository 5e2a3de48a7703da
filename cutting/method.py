"""What a method of cutting is: the blade's sweep in, a change of connectivity out."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tissue_sim.blade import Sweep
from tissue_sim.mesh import TetMesh, TopologyDelta, tetrahedron_volumes

CASES = ('A', 'B', 'C', 'D', 'E', 'F', 'G', 'H', 'star', 'separated')
LONGEST_SWEEP = 0.1


class SweepError(ValueError):
    """A sweep that cannot be cut along."""


@dataclass(frozen=True)
class Report:
    """What one call did, see `CutReport.msg`.

    Attributes:
        touched: tetrahedra that the sweep met.
        cases: tetrahedra by topological case, in the order of `CASES`, shape (10,).
        area: new cut surface, one side, rest configuration [m^2].
        removed_volume: rest volume taken out [m^3].
        worst_altitude: smallest altitude of the tetrahedra put in, at rest [m]; 0 for none.
        warnings: sentences for the log.
    """

    touched: int = 0
    cases: np.ndarray = field(default_factory=lambda: np.zeros(len(CASES), np.int64))
    area: float = 0.0
    removed_volume: float = 0.0
    worst_altitude: float = 0.0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class CutResult:
    """A change of connectivity, not yet applied, and the report on it."""

    delta: TopologyDelta
    report: Report

    @staticmethod
    def nothing() -> 'CutResult':
        """No change."""
        return CutResult(TopologyDelta(), Report())


class CutMethod(Protocol):
    """One method of cutting, with whatever it remembers between the steps of a stroke.

    Each call may assume that the result of the one before was applied to the mesh.
    """

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Cuts along a sweep.

        Args:
            mesh: the tissue.
            positions: current nodes [m], shape (n, 3); the sweep lives among them.
            sweep: the blade's edge before and after the step.
        """
        ...

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """The blade has left: finalises what is pending, and forgets the stroke."""
        ...

    def abort(self) -> None:
        """Forgets the stroke; the mesh stays as it is."""
        ...


def check_sweep(sweep: Sweep) -> None:
    """Refuses a sweep that is no step of a blade.

    Raises:
        SweepError: with a sentence that says which value is wrong and what would be right.
    """
    points = np.array([sweep.root_from, sweep.tip_from, sweep.root_to, sweep.tip_to])
    if not np.isfinite(points).all():
        raise SweepError('the sweep has a coordinate that is not finite')
    extent = float(np.ptp(points, axis=0).max())
    if extent > LONGEST_SWEEP:
        raise SweepError(
            f'the sweep spans {extent:.3g} m; a step of the blade spans {LONGEST_SWEEP} m at most'
        )
    if sweep.area < 1e-12:
        raise SweepError(f'the sweep has an area of {sweep.area:.3g} m^2; it has to be above 1e-12')


def removed_volume(mesh: TetMesh, tetrahedra: np.ndarray) -> float:
    """Rest volume of some tetrahedra [m^3]."""
    return float(tetrahedron_volumes(mesh.rest, mesh.tetrahedra[tetrahedra]).sum())
