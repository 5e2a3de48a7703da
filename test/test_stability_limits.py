"""Just below its limit every method survives ten thousand steps; just above it is caught and named.

The limit is that of the true highest frequency, by dense eigenvalues, not of the bound that the
trainer uses: on a block as it was loaded, nearly incompressible, and cut at the true crossings.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from meshes import irregular_box
from pairs import EXPLICIT, thinned

from bench.cuts.strokes import results_along
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.stability import step_bound
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

pytestmark = pytest.mark.long

ALPHA, BETA = 5.0, 2e-4
SIZE = 0.005
STEPS = 100
"""Of a frame."""


@dataclass(frozen=True)
class Block:
    nu: float
    cut: bool

    def mesh(self) -> TetMesh:
        nodes, tets = irregular_box((3, 2, 2), SIZE, 3, jitter=0.15)
        return TetMesh(nodes, tets, nodes[:, 2] < 1e-9)


WHOLE, STIFF, CUT = Block(0.4, False), Block(0.499, False), Block(0.4, True)
BLOCKS = {'whole': WHOLE, 'nearly incompressible': STIFF, 'cut': CUT}
every_case = pytest.mark.parametrize(
    ('block', 'integrator', 'name'), thinned(BLOCKS, EXPLICIT, MODELS)
)


@cache
def changes() -> tuple[TopologyDelta, ...]:
    """What a blade through the block does that cuts it where it passes: slivers."""
    mesh, deltas = CUT.mesh(), []
    cutter = make_method(CuttingSettings.model_validate({'method': 'subdivide'}))
    way = np.linspace(-0.002, 0.012, 6)
    path = np.array([[[0.0083, y, 0.02], [0.0083, y, 0.0042]] for y in way])
    for result in results_along(cutter, mesh, path):
        if not result.delta.empty:
            mesh.apply(result.delta)
            deltas.append(result.delta)
    return tuple(deltas)


def dynamics_of(block: Block, name: ModelName, stepping: TimeStepping) -> Dynamics:
    """The block, cut if it is to be, and shaken."""
    material = Material(5000.0, block.nu, 1000.0, ALPHA, BETA)
    dynamics = Dynamics(block.mesh(), material, name, stepping)
    for delta in changes() if block.cut else ():
        dynamics.apply_cut(delta)
    free = dynamics.mesh.fixed == 0
    noise = np.random.default_rng(0).normal(size=(int(free.sum()), 3))
    dynamics.displacement[free] = 1e-5 * noise
    dynamics.restart()
    return dynamics


@cache
def highest(block: Block, name: ModelName) -> float:
    """The highest frequency [rad/s], small nodes with the mass that they got by the cut."""
    dynamics = dynamics_of(block, name, TimeStepping('rk4'))
    root = np.sqrt(dynamics.masses.inverse)
    stiffness = root[:, None] * dynamics.model.dense() * root
    return float(np.sqrt(np.linalg.eigvalsh(stiffness)[-1]))


def at_share(
    block: Block, name: ModelName, integrator: IntegratorName, share: float
) -> tuple[Dynamics, float]:
    """The block, stepped by a share of the true limit; and that limit [s]."""
    limit = step_bound(integrator, highest(block, name), ALPHA, BETA)
    stepping = TimeStepping(
        integrator, rate=1 / (STEPS * share * limit), safety=100.0, min_substeps=STEPS
    )
    return dynamics_of(block, name, stepping), limit


def test_the_cut_block_has_slivers() -> None:
    mesh = CUT.mesh()
    for delta in changes():
        mesh.apply(delta)
    assert mesh.volumes().min() < 0.02 * SIZE**3 / 6


@every_case
def test_ten_thousand_steps_just_below_the_limit_give_no_trouble(
    block: str, integrator: IntegratorName, name: ModelName
) -> None:
    dynamics, _ = at_share(BLOCKS[block], name, integrator, 0.99)
    for _ in range(10_000 // STEPS):
        motion = dynamics.advance(Coupling())
        assert not motion.trouble
    assert motion.substeps == STEPS
    assert np.abs(dynamics.displacement).max() < 1e-4


@every_case
def test_just_above_the_limit_is_caught_and_named_and_shorter_steps_taken(
    block: str, integrator: IntegratorName, name: ModelName
) -> None:
    dynamics, limit = at_share(BLOCKS[block], name, integrator, 1.05)
    start = dynamics.model.evaluate(dynamics.displacement)[1]
    for _ in range(10_000 // STEPS):
        motion = dynamics.advance(Coupling())
        if motion.trouble:
            break
    assert 'the tool has put in' in motion.trouble or 'farther than' in motion.trouble
    assert f'a step of {1e3 * 1.05 * limit:.3g} ms is above' in motion.trouble
    assert f'{integrator} is stable at' in motion.trouble and 'rad/s' in motion.trouble
    assert motion.diverged or motion.substeps > STEPS
    assert not motion.diverged or not motion.elastic_force.any()
    assert motion.kinetic_energy + motion.elastic_energy < 3 * start
    assert np.abs(dynamics.displacement).max() < 1e-4
