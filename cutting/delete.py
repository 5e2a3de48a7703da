"""Element deletion, the thesis's own baseline (5.2.1, 7.6.1): it loses mass and leaves a gap."""

import numpy as np

from cutting.method import CutResult, Report, removed_volume
from cutting.propagation import touched_tetrahedra
from tissue_sim.blade import Sweep
from tissue_sim.mesh import TetMesh, TopologyDelta


class DeleteMethod:
    """Takes out every tetrahedron that the sweep meets.

    Limitations: removes tissue, the gap is as wide as the elements, and what is left may hang
    together by a node or an edge only.
    """

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Takes out what the sweep meets."""
        met = touched_tetrahedra(mesh, positions, sweep, None)
        report = Report(touched=len(met), removed_volume=removed_volume(mesh, met))
        return CutResult(TopologyDelta(removed_tetrahedra=met), report)

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """Nothing is ever pending."""
        return CutResult(TopologyDelta(), Report())

    def abort(self) -> None:
        """Nothing is ever pending."""
