"""Interface of the cutting methods: a sweep of the blade in, a change of connectivity out."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.contact.tool import CutCommand, CutOutcome
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta, tetrahedron_volumes

CASES = ('A', 'B', 'C', 'D', 'E', 'F', 'G', 'H', 'star', 'separated')
MAX_SWEEP = 0.1


class SweepError(ValueError):
    """A sweep that is not valid."""


FAILURES = (MeshError, AssertionError, ValueError, KeyError, IndexError)
"""Errors of a failed cut, after which the state of the method is unknown."""


@dataclass(frozen=True)
class CutReport:
    """Report of one call, see `CutReport.msg`.

    Attributes:
        touched: number of tetrahedra met by the sweep.
        cases: number of tetrahedra by topological case, in the order of `CASES`, shape (10,).
        area: new cut surface, one side, rest configuration [m^2].
        removed_volume: removed rest volume [m^3].
        worst_altitude: smallest altitude of the new tetrahedra at rest [m]; 0 without any.
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
    """A change of connectivity to be applied, and its report."""

    delta: TopologyDelta
    report: CutReport

    @staticmethod
    def nothing() -> 'CutResult':
        """Return an empty change."""
        return CutResult(TopologyDelta(), CutReport())


class CutMethod(Protocol):
    """A method of cutting, with its state between the steps of a stroke.

    Each call assumes that the previous result was applied to the mesh.
    """

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Cut along a sweep.

        Args:
            mesh: the tissue.
            positions: current nodes [m], shape (n, 3), the frame of the sweep.
            sweep: the blade's edge before and after the step.
        """
        ...

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """Put all pending crossings into the mesh and forget the stroke, after the blade has
        left.
        """
        ...

    def abort(self) -> None:
        """Forget the stroke; the mesh stays unchanged."""
        ...


def check_sweep(sweep: Sweep) -> None:
    """Refuse a sweep that is no step of a blade.

    Raises:
        SweepError: one sentence with the wrong value and the right one.
    """
    points = np.array([sweep.root_from, sweep.tip_from, sweep.root_to, sweep.tip_to])
    if not np.isfinite(points).all():
        raise SweepError('the sweep has a coordinate that is not finite')
    extent = float(np.ptp(points, axis=0).max())
    if extent > MAX_SWEEP:
        raise SweepError(
            f'the sweep spans {extent:.3g} m; a step of the blade spans {MAX_SWEEP} m at most'
        )
    if sweep.area < 1e-12:
        raise SweepError(f'the sweep has an area of {sweep.area:.3g} m^2; it has to be above 1e-12')


def carry_out(
    method: CutMethod,
    mesh: TetMesh,
    positions: np.ndarray,
    command: CutCommand,
    sweep: Sweep | None,
) -> CutResult:
    """Execute a command of the simulation.

    Args:
        method: of cutting.
        mesh: the tissue; the change is not applied.
        positions: of its nodes [m], shape (n, 3).
        command: of the simulation.
        sweep: of the blade, with an ADVANCE.

    Raises:
        SweepError: the sweep is refused; nothing has changed.
        one of `FAILURES`: the cut failed, and the stroke has to begin anew.
    """
    if command is CutCommand.FINISH:
        return method.finish(mesh, positions)
    if sweep is None:
        raise SweepError('an ADVANCE has no sweep')
    check_sweep(sweep)
    return method.advance(mesh, positions, sweep)


def outcome_of(
    method: CutMethod,
    mesh: TetMesh,
    positions: np.ndarray,
    command: CutCommand,
    sweep: Sweep | None,
) -> tuple[CutOutcome, CutResult]:
    """Return the outcome as the node `cutting` would report it; arguments as for `carry_out`."""
    try:
        result = carry_out(method, mesh, positions, command, sweep)
    except SweepError:
        return CutOutcome.REFUSED, CutResult.nothing()
    except FAILURES:
        method.abort()
        return CutOutcome.LOST, CutResult.nothing()
    return (CutOutcome.EMPTY if result.delta.empty else CutOutcome.APPLIED), result


def removed_volume(mesh: TetMesh, tetrahedra: np.ndarray) -> float:
    """Return the rest volume of some tetrahedra [m^3]."""
    return float(tetrahedron_volumes(mesh.rest, mesh.tetrahedra[tetrahedra]).sum())
