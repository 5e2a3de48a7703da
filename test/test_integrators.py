"""Orders, energy and limits of the integrators, with every elastic model."""

import numpy as np
import pytest
from meshes import box, irregular_box
from pairs import EXPLICIT, every_pair

from cutting_trainer.tissue_sim.contact.coupling import HOLD, NO_SPRINGS, PUSH, Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import Integrator, IntegratorName
from cutting_trainer.tissue_sim.motion.stability import amplification, step_bound
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

every_model = pytest.mark.parametrize('name', MODELS)


def small_block(nu: float = 0.4) -> tuple[TetMesh, Material]:
    nodes, tets = irregular_box((2, 2, 2), 0.01, 3, 0.15)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9), Material(5000.0, nu, 1000.0, 5.0, 2e-4)


def highest(model: ElasticModel, inverse: np.ndarray) -> float:
    root = np.sqrt(inverse)
    return float(np.sqrt(np.linalg.eigvalsh(root[:, None] * model.dense() * root)[-1]))


def vibrate(integrator: IntegratorName, steps: int, seconds: float) -> float:
    """Error of a free damped vibration in its three softest modes, relative to its size."""
    mesh, material = small_block()
    alpha, beta = 3.0, 2e-4
    model = ElasticModel(mesh, material)
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / model.mass), 3)
    root = np.sqrt(inverse)
    squares, modes = np.linalg.eigh(root[:, None] * model.dense() * root)
    # The softest three modes: their motion is smooth on the scale of the step.
    moving = np.flatnonzero(squares > 1.0)[:3]
    rates = (alpha + beta * squares[moving]) / 2
    turns = np.sqrt(squares[moving] - rates**2)
    shapes = root[:, None] * modes[:, moving] * 1e-4
    swing = np.cos(turns * seconds) + rates / turns * np.sin(turns * seconds)
    exact = shapes @ (np.exp(-rates * seconds) * swing)
    u, v = shapes.sum(axis=1), np.zeros(len(root))
    Integrator(integrator, alpha, beta, tolerance=1e-13).step(
        model.operands(), inverse, model.diagonal, NO_SPRINGS, u, v,
        seconds / steps, steps,
    )  # fmt: skip
    return float(np.abs(u - exact).max() / np.abs(shapes).max())


@pytest.mark.long
@pytest.mark.parametrize(
    ('integrator', 'order', 'steps'),
    [('euler', 1, 400), ('symplectic_euler', 1, 200), ('rk4', 4, 60), ('implicit', 1, 200)],
)
def test_error_falls_with_the_order_of_the_integrator(
    integrator: IntegratorName, order: int, steps: int
) -> None:
    errors = np.array([vibrate(integrator, steps * 2**k, 0.05) for k in range(3)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (np.abs(orders - order) < 0.25).all(), orders


def free_energy(integrator: IntegratorName, share: float, steps: int) -> np.ndarray:
    """Energy over that at the start, after each of some steps without damping."""
    mesh, material = small_block()
    model = ElasticModel(mesh, material)
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / model.mass), 3)
    mass = np.where(inverse > 0, 1 / np.maximum(inverse, 1e-300), 0.0)
    dt = share / highest(model, inverse)
    u = np.where(inverse > 0, np.random.default_rng(1).normal(size=len(inverse)) * 1e-5, 0.0)
    v, stepper, energies = np.zeros_like(u), Integrator(integrator, 0.0, 0.0), []
    start = model.evaluate(u.reshape(-1, 3))[1]
    for _ in range(steps):
        stepper.step(model.operands(), inverse, model.diagonal, NO_SPRINGS, u, v, dt, 1)
        energies.append(model.evaluate(u.reshape(-1, 3))[1] + mass @ v**2 / 2)
    return np.array(energies) / start


def test_without_damping_energy_is_kept_to_the_order() -> None:
    for share, order in ((0.4, 5), (0.2, 5)):
        drift = 1 - free_energy('rk4', share, 200)[-1]
        assert 0 < drift < 200 * share * share**order
    coarse, fine = (np.abs(free_energy('symplectic_euler', s, 400) - 1) for s in (0.4, 0.2))
    # It swings about the start, by the first order of the step, and does not drift.
    assert 1.5 < coarse.max() / fine.max() < 2.7
    assert coarse[-100:].max() < 1.5 * coarse[:100].max()


def test_forward_euler_gains_and_the_implicit_one_loses_energy() -> None:
    assert free_energy('euler', 0.2, 100)[-1] > 2.0
    assert free_energy('implicit', 0.2, 100)[-1] < 0.7


@pytest.mark.parametrize('integrator', EXPLICIT)
@pytest.mark.parametrize('beta', [1e-5, 1e-4, 1e-3, 1e-2])
def test_the_step_bound_separates_decay_from_growth(integrator, beta: float) -> None:
    omega = 700.0
    dt = step_bound(integrator, omega, 1.0, beta)
    modes = omega * np.linspace(0.01, 1, 2000)
    assert amplification(integrator, modes, 1.0, beta, 0.999 * dt).max() <= 1
    assert amplification(integrator, modes, 1.0, beta, 1.02 * dt).max() > 1


def test_step_bounds_are_those_of_textbooks() -> None:
    assert step_bound('rk4', 700.0, 0.0, 0.0) == pytest.approx(2 * np.sqrt(2) / 700, rel=1e-5)
    assert step_bound('symplectic_euler', 700.0, 0.0, 0.0) == pytest.approx(2 / 700, rel=1e-5)
    assert step_bound('euler', 700.0, 0.0, 0.0) == 0.0
    assert step_bound('euler', 700.0, 5.0, 1e-4) == pytest.approx(1e-4 + 5 / 700**2, rel=1e-3)
    assert step_bound('implicit', 700.0, 0.0, 0.0) == np.inf


def grown_by(integrator: IntegratorName, name: ModelName, nu: float, share: float) -> float:
    """Energy after many steps over that at the start, at a share of the limit for the mesh."""
    mesh, material = small_block(nu)
    model = ElasticModel(mesh, material, name)
    inverse = np.repeat(np.where(mesh.fixed == 1, 0.0, 1 / model.mass), 3)
    dt = 1.0 / 30.0
    if integrator != 'implicit':
        omega = highest(model, inverse)
        dt = share * step_bound(integrator, omega, material.alpha, material.beta)
    u = np.where(inverse > 0, np.random.default_rng(0).normal(size=len(inverse)) * 1e-6, 0.0)
    v = np.zeros_like(u)
    start = model.evaluate(u.reshape(-1, 3))[1]
    stepper = Integrator(integrator, material.alpha, material.beta)
    with np.errstate(all='ignore'):
        for _ in range(10 if integrator != 'implicit' else 1):
            stepper.step(model.operands(), inverse, model.diagonal, NO_SPRINGS, u, v, dt, 1000)
            if not np.abs(u).max() < 1.0:
                return np.inf
    return model.evaluate(u.reshape(-1, 3))[1] / start


@pytest.mark.long
@every_pair
@pytest.mark.parametrize('nu', [0.4, 0.499])
def test_ten_thousand_steps_just_below_the_limit_decay_and_just_above_it_grow(
    integrator: IntegratorName, name: ModelName, nu: float
) -> None:
    """The implicit one has no limit: a thousand steps of a frame each."""
    assert grown_by(integrator, name, nu, 0.99) < 0.1
    if integrator != 'implicit':
        assert grown_by(integrator, name, nu, 1.03) > 10.0


@every_model
def test_the_frequency_bound_lies_above_the_highest_frequency_and_not_far(name: ModelName) -> None:
    mesh, material = small_block()
    dynamics = Dynamics(mesh, material, name)
    true = highest(dynamics.model, dynamics.masses.inverse)
    assert true < dynamics.masses.omega < 1.05 * true


def held(integrator: IntegratorName, name: ModelName, mode: int) -> tuple[Dynamics, Coupling]:
    """A block under a tool until it rests."""
    nodes, tets = box((4, 4, 3), 0.01)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    material = Material(5000.0, 0.4, 1000.0, 20.0, 2e-3)
    substeps = 4 if integrator == 'implicit' else 1
    stepping = TimeStepping(integrator, min_substeps=substeps, max_substeps=2000)
    dynamics = Dynamics(mesh, material, name, stepping)
    top = int(np.argmin(np.linalg.norm(nodes - [0.02, 0.02, 0.03], axis=1)))
    target = nodes[top] - [0, 0, 0.003]
    coupling = Coupling(mode, np.array([top]), np.ones(1), target, target, stiffness=200.0)
    for _ in range(60):
        assert not dynamics.advance(coupling).trouble
    return dynamics, coupling


@every_pair
@pytest.mark.parametrize('mode', [PUSH, HOLD])
def test_under_a_tool_all_come_to_the_same_rest(
    integrator: IntegratorName, name: ModelName, mode: int
) -> None:
    dynamics, coupling = held(integrator, name, mode)
    force = dynamics.model.force(dynamics.displacement)
    spring = coupling.force(dynamics.positions)
    loaded = int(coupling.nodes[0])
    assert np.linalg.norm(spring) > 0.02
    np.testing.assert_allclose(force[loaded], spring, atol=2e-3 * np.linalg.norm(spring))
    others = (dynamics.mesh.fixed == 0) & (np.arange(len(force)) != loaded)
    assert np.abs(force[others]).max() < 2e-3 * np.linalg.norm(spring)


@every_model
def test_the_implicit_integrator_lets_go_of_what_does_not_push(name: ModelName) -> None:
    dynamics, coupling = held('implicit', name, PUSH)
    away = coupling.end + np.array([0, 0, 0.01])
    gone = Coupling(PUSH, coupling.nodes, coupling.weights, away, away, stiffness=200.0)
    for _ in range(40):
        assert not dynamics.advance(gone).trouble
    assert np.abs(dynamics.displacement).max() < 1e-5
