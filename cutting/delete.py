"""Element deletion, the baseline of the thesis (5.2.1, 7.6.1): it loses mass and leaves a gap."""

import numpy as np

from cutting_trainer.cutting.broad_phase import touched_tetrahedra
from cutting_trainer.cutting.method_interface import CutReport, CutResult, removed_volume
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta


class DeleteMethod:
    """Removes every tetrahedron met by the sweep.

    Limitations: it removes tissue, the gap is as wide as the elements, and the rest may be
        connected by a node or an edge only.
    """

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Remove the tetrahedra met by the sweep."""
        met = touched_tetrahedra(mesh, positions, sweep, None)
        report = CutReport(touched=len(met), removed_volume=removed_volume(mesh, met))
        return CutResult(TopologyDelta(removed_tetrahedra=met), report)

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """Do nothing: no crossing is ever pending."""
        return CutResult(TopologyDelta(), CutReport())

    def abort(self) -> None:
        """Do nothing: no crossing is ever pending."""
