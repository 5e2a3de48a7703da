"""Element deletion, the baseline of the thesis (5.2.1, 7.6.1): it loses mass and leaves a gap."""

import numpy as np

from cutting_trainer.cutting.broad_phase import touched_tetrahedra
from cutting_trainer.cutting.method_interface import CutReport, CutResult, removed_volume
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta

_REMOVED = 'the stroke has removed {:.2f} cm^3 of tissue at rest: `delete` reports no area of a cut'


class DeleteMethod:
    """Removes every tetrahedron met by the sweep.

    Limitations: it removes tissue, the gap is as wide as the elements, and the rest may be
        connected by a node or an edge only. It opens no faces that meet: the area that it reports
        is zero, and the end of a stroke names the volume instead.
    """

    def __init__(self) -> None:
        self._removed = 0.0

    def advance(self, mesh: TetMesh, positions: np.ndarray, sweep: Sweep) -> CutResult:
        """Remove the tetrahedra met by the sweep."""
        met = touched_tetrahedra(mesh, positions, sweep, None)
        report = CutReport(touched=len(met), removed_volume=removed_volume(mesh, met))
        self._removed += report.removed_volume
        return CutResult(TopologyDelta(removed_tetrahedra=met), report)

    def finish(self, mesh: TetMesh, positions: np.ndarray) -> CutResult:
        """Name the volume that the stroke has removed; no crossing is ever pending."""
        removed, self._removed = self._removed, 0.0
        said = (_REMOVED.format(1e6 * removed),) if removed > 0.0 else ()
        return CutResult(TopologyDelta(), CutReport(warnings=said))

    def abort(self) -> None:
        """Forget the stroke; no crossing is ever pending."""
        self._removed = 0.0
