"""Error and savings of the active region: one place of a large slab is palpated."""

import time
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.problems import Errors
from bench.accuracy.reference import Solid
from bench.common.meshes import PLANE_TOLERANCE_M, kuhn_block
from cutting_trainer.tissue_sim.contact.coupling import PUSH, Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

Floats = NDArray[np.float64]

ALPHA, BETA = 15.0, 1e-4
"""Damping of the scenes [1/s], [s]: without it nothing that has been touched would ever sleep."""
_PRESS_FRAMES, _HOLD_END_FRAME, _FRAMES = 8, 28, 42
"""Last frame of the indentation, last frame of the hold, and number of frames."""
_DEPTH = 0.004
_RADIUS = 0.01
_REPEATS = 3


@dataclass(frozen=True)
class Course:
    """A palpation.

    Attributes:
        displacement: after each frame [m], shape (f, n, 3).
        force: of the tool on the tissue after each frame [N], shape (f, 3).
        cost: CPU time by simulated time [s/s].
        step: [s].
    """

    displacement: Floats
    force: Floats
    cost: float
    step: float


def describe(active: ActiveSettings) -> str:
    """Return a region in the words of the table: off, on and its tolerance [m/s], budget and its
    nodes.
    """
    if active.mode == 'off':
        return 'off'
    size = f'{active.tolerance:g}' if active.mode == 'on' else f'{active.nodes}'
    return f'{active.mode} {size}'


class LocalPalpation:
    """A slab 16 x 16 x 4 cm, fixed at its underside, pressed at one place, held and let go.

    The comparison is of the whole motion on one mesh: the error is that of the region, and of the
    step, and not that of the elements.
    """

    name = 'active_region'
    title = 'Active region: one place of a large slab palpated, ν 0.47'
    reference_name = 'all nodes, RK4 at half of the step'
    resolutions = (3, 6)
    solid = Solid((0.16, 0.16, 0.04), 5000.0, 0.47)
    model: ModelName = 'linear_smoothed'
    integrator: IntegratorName = 'symplectic_euler'

    def regions(self, resolution: int) -> tuple[ActiveSettings, ...]:
        """Return the tried regions: all nodes, three tolerances, three shares of the nodes."""
        nodes = self.mesh(resolution).node_count
        return (
            ActiveSettings(),
            *(ActiveSettings('on', tolerance=speed) for speed in (1e-2, 1e-3, 1e-4)),
            *(ActiveSettings('budget', nodes=nodes // part) for part in (16, 8, 4)),
        )

    def mesh(self, resolution: int) -> TetMesh:
        """Return the slab, with so many bricks over its depth."""
        across = 4 * resolution
        whole = kuhn_block((across, across, resolution), self.solid.size)
        return TetMesh(whole.rest, whole.tetrahedra, whole.rest[:, 2] < PLANE_TOLERANCE_M)

    def palpate(self, resolution: int, active: ActiveSettings) -> tuple[Errors, Course]:
        """Return errors against the reference, root of mean squares over the whole motion, and the
        motion.

        The cost is the median of some runs.
        """
        stepping = TimeStepping(self.integrator)
        runs = [self._course(resolution, active, stepping) for _ in range(_REPEATS)]
        exact = self._reference(resolution)
        wrong = [
            float(np.linalg.norm(found - right) / np.linalg.norm(right))
            for found, right in (
                (runs[0].displacement, exact.displacement),
                (runs[0].force, exact.force),
            )
        ]
        cost = float(np.median([run.cost for run in runs]))
        return Errors(*wrong), replace(runs[0], cost=cost)

    @cache  # noqa: B019  one problem lives as long as the command
    def _reference(self, resolution: int) -> Course:
        fine = TimeStepping('rk4', safety=0.4, max_substeps=10_000)
        return self._course(resolution, ActiveSettings(), fine)

    def _course(self, resolution: int, active: ActiveSettings, stepping: TimeStepping) -> Course:
        s = self.solid
        material = Material(s.youngs_modulus, s.poissons_ratio, s.density, ALPHA, BETA)
        dynamics = Dynamics(self.mesh(resolution), material, self.model, stepping, active)
        rest = dynamics.mesh.rest
        middle = np.array([s.size[0] / 4, s.size[1] / 4, s.size[2]])
        distance = np.linalg.norm(rest - middle, axis=1)
        weights = np.where(
            rest[:, 2] > s.size[2] - PLANE_TOLERANCE_M, 1 - (distance / _RADIUS) ** 2, 0.0
        )
        nodes = np.flatnonzero(weights > 0)
        share = weights[nodes] / weights[nodes].sum()
        here = share @ rest[nodes]
        shapes, forces, spent = [], [], 0.0
        for frame in range(_FRAMES):
            before, after = (
                here - [0.0, 0.0, _DEPTH * min(k, _PRESS_FRAMES) / _PRESS_FRAMES]
                for k in (frame, frame + 1)
            )
            pressing = Coupling(PUSH, nodes, share, before, after, stiffness=200.0)
            coupling = pressing if frame < _HOLD_END_FRAME else Coupling()
            began = time.thread_time()
            motion = dynamics.advance(coupling)
            spent += time.thread_time() - began
            shapes.append(dynamics.displacement.copy())
            forces.append(coupling.force(dynamics.positions))
        cost = spent / _FRAMES * stepping.rate / motion.slow_motion
        step = motion.slow_motion / stepping.rate / motion.substeps
        return Course(np.array(shapes), np.array(forces), cost, step)
