"""Free vibration of a cantilever without damping, over one period of its lowest mode."""

import time
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.problems import Errors
from bench.accuracy.reference import HexGrid, Solid, graded
from bench.common.meshes import PLANE_TOLERANCE_M, beam
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

Floats = NDArray[np.float64]

_AMPLITUDE = 1e-4


class Vibration:
    """A beam 10 x 2 x 2 cm, clamped at one end, let go in the shape of its lowest mode.

    The reference's shape is that of quadratic hexahedra whose nodes are among those of every mesh
    here; its motion is a cosine.
    """

    name = 'vibration'
    title = 'Free vibration of a cantilever, ν 0.3, one period'
    reference_name = 'scikit-fem, lowest mode of quadratic hexahedra'
    resolutions = (2, 4, 8)
    solid = Solid((0.10, 0.02, 0.02), 5000.0, 0.3)

    @cached_property
    def reference(self) -> tuple[float, dict[tuple[int, ...], Floats]]:
        """Frequency [rad/s], and the mode at its nodes [m] by place in tenths of millimetres."""
        length, width, height = self.solid.size
        planes = (graded(length, 20), graded(width, 4), graded(height, 4))
        grid = HexGrid(self.solid, planes)
        x = grid.places
        held = np.concatenate(
            [grid.components(x[:, 0] < PLANE_TOLERANCE_M, axis) for axis in range(3)]
        )
        # Square sections have two bending modes: this one bends along z.
        held = np.append(held, grid.components(abs(x[:, 1] - width / 2) < PLANE_TOLERANCE_M, 1))
        omega, mode = grid.lowest_mode(np.unique(held))
        mode *= _AMPLITUDE / abs(mode).max()
        shape: dict[tuple[int, ...], Floats] = {}
        for axis in range(3):
            for dof in grid.components(np.ones(len(x), bool), axis):
                place = tuple(np.rint(1e4 * x[dof]).astype(int).tolist())
                shape.setdefault(place, np.zeros(3))[axis] = mode[dof]
        return omega, shape

    def swing(
        self, model: ModelName, resolution: int, stepping: TimeStepping
    ) -> tuple[Errors, float, float]:
        """Let a mesh vibrate.

        Returns:
            Root of the mean squares of the errors over those of the exact motion: of the end's
            displacement, and of the force at the clamp; CPU time by simulated time; step [s].
        """
        omega, shape = self.reference
        mesh = beam(self.solid, resolution)
        s = self.solid
        material = Material(s.youngs_modulus, s.poissons_ratio, s.density)
        dynamics = Dynamics(mesh, material, model, stepping)
        places = np.rint(1e4 * mesh.rest).astype(int)
        start = np.array([shape[tuple(place)] for place in places.tolist()])
        dynamics.displacement[:] = start
        end = mesh.rest[:, 0] > s.size[0] - PLANE_TOLERANCE_M
        full = self._clamp_force(omega)
        frames = int(np.ceil(2 * np.pi / omega * stepping.rate))
        seen, exact, spent = [], [], []
        for frame in range(1, frames + 1):
            began = time.thread_time()
            motion = dynamics.advance(Coupling())
            spent.append(time.thread_time() - began)
            force = motion.elastic_force[mesh.fixed == 1, 2].sum()
            seen.append((dynamics.displacement[end, 2].mean(), force))
            turn = np.cos(omega * frame / stepping.rate)
            exact.append((start[end, 2].mean() * turn, full * turn))
        wrong = np.sqrt(
            np.square(np.subtract(seen, exact)).mean(axis=0) / np.square(exact).mean(axis=0)
        )
        cost = float(np.median(spent)) * stepping.rate / motion.slow_motion
        step = motion.slow_motion / stepping.rate / motion.substeps
        return Errors(float(wrong[0]), float(wrong[1])), cost, step

    def _clamp_force(self, omega: float) -> float:
        """Return the force of the clamp along z at the start of the exact motion.

        From a fine mesh of the trainer's own: the mode is the reference's, and mass needs no
        elasticity.
        """
        mesh = beam(self.solid, 8)
        _, shape = self.reference
        s = self.solid
        mass = ElasticModel(mesh, Material(s.youngs_modulus, 0.3, s.density)).mass
        places = np.rint(1e4 * mesh.rest).astype(int)
        mode = np.array([shape[tuple(place)] for place in places.tolist()])
        return -float(omega**2 * mass @ mode[:, 2])
