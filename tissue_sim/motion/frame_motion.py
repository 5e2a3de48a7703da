"""Motion of the tissue in one frame: what `Dynamics` returns."""

from dataclasses import dataclass

import numpy as np

from cutting_trainer.tissue_sim.mesh.strain import Strain


@dataclass(frozen=True)
class FrameMotion:
    """Motion of one frame.

    Attributes:
        elastic_force: against the displacement, less weight and viscous relief [N], shape (n, 3).
        kinetic_energy, elastic_energy: [J]; the latter with that of weight and viscosity.
        substeps: number of substeps.
        slow_motion: simulated time over frame time.
        trouble: the error; empty: none.
        diverged: shorter steps did not help, and the frame was rolled back.
        strain: of a model with a law.
    """

    elastic_force: np.ndarray
    kinetic_energy: float
    elastic_energy: float
    substeps: int
    slow_motion: float
    trouble: str = ''
    diverged: bool = False
    strain: Strain | None = None
