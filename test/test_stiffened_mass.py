"""Step and masses of a stiffening tissue: the true frequency stays below the one stepped for."""

from itertools import pairwise

import numpy as np
import pytest
from meshes import box, irregular_box
from strokes import method_named, straight

from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.contact.coupling import HOLD, Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping

pytestmark = pytest.mark.long

MIDDLE = np.array([0.0125, 0.01, 0.02])


def tissue(
    nu: float = 0.45, stiffening: float = 6.0, jitter: float = 0.2, growth: float = 3.0
) -> Dynamics:
    nodes, tets = irregular_box((5, 4, 4), 0.005, 1, jitter)
    material = Material(5400.0, nu, 1060.0, 10.0, 1e-4, stiffening)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    stepping = TimeStepping('symplectic_euler', frequency_growth=growth)
    return Dynamics(mesh, material, 'stiffening', stepping)


def shape(nodes: np.ndarray, kind: str) -> np.ndarray:
    u = np.zeros_like(nodes)
    if kind == 'pulled':
        u[:, 0] = 0.008 * np.exp(-np.square(nodes - MIDDLE).sum(axis=1) / 0.005**2)
    elif kind == 'pressed':
        u[:, 2] = -0.006 * np.exp(-np.square(nodes - MIDDLE).sum(axis=1) / 0.008**2)
    else:
        angle = nodes[:, 2] / 0.02 * 1.2
        x, y = (nodes[:, :2] - MIDDLE[:2]).T
        u[:, 0] = np.cos(angle) * x - np.sin(angle) * y - x
        u[:, 1] = np.sin(angle) * x + np.cos(angle) * y - y
    return u


def highest_frequency(dynamics: Dynamics, flat: np.ndarray, inverse: np.ndarray) -> float:
    """Of the tangent, by differences of the force [rad/s]."""
    n, step = len(flat), 1e-9
    tangent = np.empty((n, n))
    for i in range(n):
        ahead = flat.copy()
        ahead[i] += step
        behind = flat.copy()
        behind[i] -= step
        difference = dynamics.model.force(ahead.reshape(-1, 3)) - dynamics.model.force(
            behind.reshape(-1, 3)
        )
        tangent[i] = difference.ravel() / (2 * step)
    free = inverse > 0
    root = np.sqrt(inverse[free])
    scaled = root[:, None] * ((tangent + tangent.T) / 2)[np.ix_(free, free)] * root
    return float(np.sqrt(np.linalg.eigvalsh(scaled)[-1]))


def adapted(dynamics: Dynamics, flat: np.ndarray) -> tuple[float, np.ndarray]:
    """Frequency of the step [rad/s], and inverse masses, of a displacement."""
    stiffened, whole = dynamics.masses._stiffened, dynamics.model.operands()
    assert stiffened is not None
    stiffened.begin(flat, dynamics.masses._frequency.omega, dynamics.masses.inverse, whole)
    inverse = stiffened.adapt(flat, np.zeros_like(flat), dynamics.masses.inverse, whole)
    return stiffened.omega, inverse


@pytest.mark.parametrize('kind', ['pulled', 'pressed', 'twisted'])
@pytest.mark.parametrize(('nu', 'stiffening'), [(0.45, 6.0), (0.3, 12.0)])
def test_no_tangent_is_faster_than_the_step_allows(kind: str, nu: float, stiffening: float) -> None:
    dynamics = tissue(nu, stiffening)
    flat = shape(dynamics.mesh.rest, kind).ravel()
    omega, inverse = adapted(dynamics, flat)
    assert (
        highest_frequency(dynamics, flat, inverse) < omega <= 2 * dynamics.masses.uncut * (1 + 1e-9)
    )
    assert highest_frequency(dynamics, flat, dynamics.masses.inverse) > 1.2 * dynamics.masses.uncut


@pytest.mark.parametrize('seed', range(4))
def test_no_tangent_of_small_elements_beside_a_cut_is_faster_either(seed: int) -> None:
    """They have few neighbours, and stiffen one by one: sums of rows say little of them."""
    dynamics = tissue(growth=1.1)
    rng, method = np.random.default_rng(seed), method_named()
    ends = np.array([[-0.002, 0.009, 0.011], [0.027, 0.012, 0.012]])
    way = straight(*(ends + rng.uniform(-0.003, 0.003, (2, 3))), (0.0, 0.001, 0.02), 8)
    for before, after in pairwise(way):
        sweep = Sweep(before[0], before[1], after[0], after[1])
        dynamics.apply_cut(method.advance(dynamics.mesh, dynamics.mesh.rest, sweep).delta)
    rest, cut = (
        dynamics.mesh.rest,
        np.unique(dynamics.mesh.triangles[dynamics.mesh.triangle_kind == CUT]),
    )
    worst = 0.0
    for _ in range(6):
        away = rest - rest[rng.choice(cut)]
        near = np.exp(-np.square(away).sum(axis=1) / 0.003**2)
        flat = (0.4 * near[:, None] * (away @ rng.normal(size=(3, 3)))).ravel()
        omega, inverse = adapted(dynamics, flat)
        worst = max(worst, highest_frequency(dynamics, flat, inverse) / omega)
    assert worst < 1.0


def test_frequency_growth_limits_the_substeps_of_a_strained_tissue_too() -> None:
    substeps = {}
    for growth in (1.1, 3.0):
        dynamics = tissue(growth=growth)
        held = np.argsort(np.square(dynamics.mesh.rest - MIDDLE).sum(axis=1))[:3]
        here = dynamics.mesh.rest[held].mean(axis=0)
        way = here + np.linspace(0.0, 0.012, 9)[:, None] * [1.0, 0.0, 0.0]
        weights, calm, most = np.full(3, 1 / 3), dynamics.advance(Coupling()).substeps, 0
        for start, end in pairwise([*way, way[-1], way[-1]]):
            spring = Coupling(HOLD, held, weights, start, end, np.zeros(3), 200.0)
            motion = dynamics.advance(spring)
            assert not motion.trouble
            most = max(most, motion.substeps)
        substeps[growth] = most / calm
    assert substeps[1.1] < 1.2
    assert substeps[3.0] > 1.3


def test_a_node_that_becomes_heavier_keeps_its_momentum_and_a_lighter_one_its_velocity() -> None:
    dynamics = tissue(0.3, 12.0)
    stiffened, n = dynamics.masses._stiffened, dynamics.mesh.node_count
    assert stiffened is not None
    strained = shape(dynamics.mesh.rest, 'pressed').ravel()
    v = np.repeat(np.where(dynamics.mesh.fixed == 1, 0.0, 0.1), 3)
    whole = dynamics.model.operands()
    stiffened.begin(strained, dynamics.masses._frequency.omega, dynamics.masses.inverse, whole)
    rest = stiffened.adapt(np.zeros(3 * n), v, dynamics.masses.inverse, whole).copy()
    np.testing.assert_array_equal(rest, dynamics.masses.inverse)
    before = v.copy()
    heavy = stiffened.adapt(strained, v, dynamics.masses.inverse, whole)
    assert stiffened.strain.heavier > 0 and stiffened.strain.added > 0
    free = rest > 0
    np.testing.assert_allclose(v[free] / heavy[free], before[free] / rest[free], rtol=1e-12)
    slow = v.copy()
    stiffened.adapt(np.zeros(3 * n), v, dynamics.masses.inverse, whole)
    np.testing.assert_array_equal(v, slow)
    assert stiffened.strain.heavier == 0


def test_a_tool_that_yanks_three_centimetres_in_a_frame_leaves_a_tissue_that_comes_back() -> None:
    """Also on slivers; every frame is finite, what goes wrong is said, and J is back within 1 s."""
    for seed in range(3):
        nodes, tets = box((5, 4, 4), 0.005)
        rng = np.random.default_rng(seed)
        inner = ((nodes > 1e-9) & (nodes < [0.0249, 0.0199, 0.0199])).all(axis=1)
        nodes[inner] += rng.uniform(-0.24, 0.24, (int(inner.sum()), 3)) * 0.005
        material = Material(5400.0, 0.45, 1060.0, 15.0, 1e-4, 6.0)
        mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
        dynamics = Dynamics(
            mesh, material, 'stiffening', TimeStepping('symplectic_euler', max_substeps=2000)
        )
        held = np.argsort(np.square(nodes - MIDDLE).sum(axis=1))[:3]
        middle = nodes[held].mean(axis=0)
        for k in range(8):
            pull = middle + rng.normal(size=3) * 0.03 / np.sqrt(3)
            spring = Coupling(HOLD, held, np.full(3, 1 / 3), middle, pull, np.zeros(3), 200.0)
            motion = dynamics.advance(spring)
            assert np.isfinite(motion.elastic_force).all(), (seed, k)
            assert np.isfinite(dynamics.displacement).all(), (seed, k)
            middle = pull
        for _ in range(30):
            motion = dynamics.advance(Coupling())
        assert motion.strain is not None
        assert 0.9 < motion.strain.ratio[0] <= motion.strain.ratio[1] < 1.1, (seed, motion.strain)
        assert dynamics.inverted == 0
