"""Cut faces meet: they carry compression and no tension, and slide with Coulomb's friction."""

import numpy as np
import pytest
from meshes import box

from bench.figures.blade_contact import overlap, pressed, reaction, slab
from cutting_trainer.tissue_sim.contact import cut_contact
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.contact.cut_contact_search import NearFaces
from cutting_trainer.tissue_sim.contact.friction import Friction
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state import from_state, state_of

E, MODULUS, G = 10000.0, 0.0, 1.0
CELLS, SIZE = (8, 4, 4), 0.0025
LENGTH, AREA = CELLS[0] * SIZE, CELLS[1] * CELLS[2] * SIZE**2


def parted(gap: float = 0.0) -> TetMesh:
    """A bar held at its ends, with a cut through its middle, its right half moved by a gap [m]."""
    nodes, tets = box(CELLS, SIZE)
    right = nodes[tets].mean(axis=1)[:, 0] > LENGTH / 2
    on = np.flatnonzero(abs(nodes[:, 0] - LENGTH / 2) < 1e-9)
    twin = np.arange(len(nodes))
    twin[on] = len(nodes) + np.arange(len(on))
    tets = np.where(right[:, None], twin[tets], tets)
    held = (nodes[:, 0] < 1e-9) | (nodes[:, 0] > LENGTH - 1e-9)
    held, nodes = np.append(held, np.zeros(len(on), bool)), np.concatenate([nodes, nodes[on]])
    mesh = TetMesh(nodes, tets, held)
    flat = (abs(nodes[mesh.triangles][:, :, 0] - LENGTH / 2) < 1e-9).all(axis=1)
    mesh.set_kinds(mesh.triangles.copy(), np.where(flat, CUT, 0).astype(np.uint8))
    mesh.rest[np.unique(tets[right])] += [gap, 0.0, 0.0]
    return mesh


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'rk4'])
def test_a_closed_cut_carries_compression_as_an_uncut_bar_does(integrator: IntegratorName) -> None:
    bar = Dynamics(
        parted(), Material(E, 0.0, 1000.0, 20.0, 2e-4), 'linear', TimeStepping(integrator)
    )
    assert reaction(bar, pressed(bar, 0.05)) == pytest.approx(E * AREA * 0.05, rel=1e-6)


def test_a_closed_cut_carries_no_tension() -> None:
    bar = Dynamics(parted(), Material(E, 0.0, 1000.0, 20.0, 2e-4))
    assert abs(reaction(bar, pressed(bar, -0.05))) < 1e-6 * E * AREA * 0.05
    assert bar.cut_contact.lost == 0.0


def test_a_closed_cut_sleeps_and_carries_on() -> None:
    bar = Dynamics(
        parted(), Material(E, 0.0, 1000.0, 20.0, 2e-4), active=ActiveSettings('on', tolerance=1e-5)
    )
    motion = pressed(bar, 0.05, still=60)
    assert bar.active_nodes == 0
    assert reaction(bar, motion) == pytest.approx(E * AREA * 0.05, rel=1e-3)


@pytest.mark.parametrize(
    ('shape', 'friction', 'off'),
    [
        ('straight', 0.0, 0.005),
        ('straight', 0.4, 0.005),
        ('inclined', 0.6, 0.02),
        ('wave', 0.4, 0.05),
    ],
)
def test_the_faces_of_a_cut_do_not_pass_through_each_other(
    shape: str, friction: float, off: float
) -> None:
    whole, cut = slab(shape, friction, cut=False), slab(shape, friction)
    expected = reaction(whole, pressed(whole, 0.05))
    assert reaction(cut, pressed(cut, 0.05)) == pytest.approx(expected, rel=off)
    assert overlap(cut.mesh, cut.positions) < 1e-4


def test_rounding_does_not_choose_among_the_triangles_on_which_a_node_lies() -> None:
    """In a cut that has just opened, these are all around its twin."""
    mesh, rng = parted(), np.random.default_rng(5)
    contact, still = cut_contact.CutContact(mesh, 0.3), np.zeros_like(mesh.rest)
    expected, _ = contact.find(still, still, 1e-4, 10)
    assert len(expected.nodes) == np.unique(expected.nodes[:, 0]).size > 0
    for _ in range(20):
        near, _ = contact.find(rng.uniform(-1e-12, 1e-12, still.shape), still, 1e-4, 10)
        assert np.array_equal(near.nodes, expected.nodes)


def test_faces_that_begin_in_one_another_are_moved_apart_and_that_is_no_divergence() -> None:
    """Their work is known, so that frames are neither taken back nor end where they began."""
    bar = Dynamics(parted(-0.0006), Material(E, 0.0, 1000.0, 20.0, 2e-4))
    motions = [bar.advance(Coupling()) for _ in range(40)]
    assert not [motion.trouble for motion in motions if motion.trouble]
    assert overlap(bar.mesh, bar.positions) < 5e-5
    stored = E * AREA * 0.0006**2 / LENGTH / 2  # both halves are pressed by half of it
    assert motions[-1].elastic_energy == pytest.approx(stored, rel=0.1)
    assert bar.cut_contact.recovered > stored


def test_a_triangle_that_is_pressed_flat_is_not_thrown_away() -> None:
    """The foot is many sizes of it away then, and the force was that of the whole triangle."""
    rest = np.array([[[1e-3, 1e-3, -1e-5], [0, 0, 0], [2e-3, 0, 0], [1e-3, 2e-3, 0]]])
    near = NearFaces(np.arange(4)[None], rest, np.tile([0.0, 0.0, 1.0], (1, 3, 1)))
    u, v, q = np.zeros(12), np.zeros(12), np.zeros(12)
    v[2] = -0.1
    contact = cut_contact.CutContact(parted(), 0.3)
    contact._pull = np.zeros((4, 3))
    faces = contact.operand(near, near.nodes, u, v)
    faces.inverse[:] = 1e5
    cut_contact.meet(faces, u, v, q, 1e-4, 1e-3)
    assert faces.pulls[0, 2] > 0
    u[10] = -1.998e-3
    cut_contact.meet(faces, u, v, q, 1e-4, 1e-3)
    force = np.zeros(12)
    cut_contact.subtract_pulls(faces, force)
    assert np.abs(v - 1e-3 * 1e5 * force).max() < 0.1


def test_a_corner_far_from_the_foot_is_not_thrown_away_where_node_and_foot_are_held() -> None:
    rest = np.array([[[1e-9, 1e-9, -1e-6], [0, 0, 0], [2e-3, 0, 0], [1e-3, 2e-3, 0]]])
    near = NearFaces(np.arange(4)[None], rest, np.tile([0.0, 0.0, 1.0], (1, 3, 1)))
    u, v, q = np.zeros(12), np.zeros(12), np.zeros(12)
    contact = cut_contact.CutContact(parted(), 0.3)
    contact._pull = np.zeros((4, 3))
    faces = contact.operand(near, near.nodes, u, v)
    faces.inverse[0, 2:] = 1e5
    cut_contact.meet(faces, u, v, q, 1e-4, 1e-3)
    assert np.abs(v).max() < 1e-3
    assert np.abs(faces.pulls).max() < 1.0


def nodes_that_meet(
    rest: np.ndarray, tets: list[list[int]], cut: list[list[int]], u: np.ndarray
) -> list[int]:
    """Nodes that meet one of the cut faces; all lengths are in mm."""
    mesh = TetMesh(1e-3 * rest, np.array(tets))
    kinds = [CUT if sorted(nodes) in cut else 0 for nodes in mesh.triangles.tolist()]
    assert kinds.count(CUT) == len(cut)
    mesh.set_kinds(mesh.triangles.copy(), np.array(kinds, np.uint8))
    near, _ = cut_contact.CutContact(mesh, 0.3).find(1e-3 * u, np.zeros_like(u), 1e-4, 10)
    return sorted(near.nodes[:, 0].tolist())


WEDGE = np.array([[0, -1, 0], [0, 1, 0], [2, 0, 0], [1.5, 0, -0.1], [1.5, 0, -0.2], [1.5, 0, -0.3]])


@pytest.mark.parametrize('joined', [True, False])
def test_a_node_does_not_meet_a_triangle_with_tissue_between_them(joined: bool) -> None:
    """Three elements lie around an edge. That in the middle has no cut face, and is inside out."""
    rest, u = WEDGE, np.zeros((6, 3))
    u[4:, 2] = 0.4
    tets, cut = [[0, 1, 2, 3], [0, 1, 3, 4], [0, 1, 4, 5]], [[0, 1, 2], [0, 1, 5]]
    if not joined:  # the same place and motion, of another piece
        rest, u = np.concatenate([rest, rest[[0, 1, 4]]]), np.concatenate([u, u[[0, 1, 4]]])
        tets, cut = [tets[0], [6, 7, 8, 5], [0, 1, 3, 4]], [[0, 1, 2], [5, 6, 7]]
    assert (5 in nodes_that_meet(rest, tets, cut, u)) != joined


def test_an_element_inside_out_meets_nothing() -> None:
    """Its upper face looks down then, and would be held above the faces under it."""
    plate = [[0, -1, 0], [0, 1, 0], [2, 0, 0], [0.7, 0, -1]]
    piece = [[0.3, -0.3, 0.3], [0.3, 0.3, 0.3], [1.0, 0, 0.3], [0.6, 0, 0.1]]
    rest, turned = np.array(plate + piece), np.zeros((8, 3))
    turned[4], turned[5] = rest[5] - rest[4], rest[4] - rest[5]
    tets, lower = [[0, 1, 2, 3], [4, 5, 6, 7]], [[4, 5, 7], [4, 6, 7], [5, 6, 7]]
    assert 7 in nodes_that_meet(rest, tets, [[0, 1, 2], *lower], 0 * turned)
    assert nodes_that_meet(rest, tets, [[0, 1, 2], [4, 5, 6]], turned) == []


def inclined(friction: float, angle: float, fixed: bool = True) -> tuple[Dynamics, int]:
    """A block on a plate, and its first node: the meshes of their faces do not match."""
    low, plate = box((8, 4, 1), 0.005)
    high, block = box((3, 2, 2), 0.005)
    nodes = np.concatenate([low, high + np.array([0.0063, 0.0057, 0.005])])
    held = (nodes[:, 2] < 1e-9) & fixed
    mesh = TetMesh(nodes, np.concatenate([plate, block + len(low)]), held)
    flat = (abs(nodes[mesh.triangles][:, :, 2] - 0.005) < 1e-9).all(axis=1)
    mesh.set_kinds(mesh.triangles.copy(), np.where(flat, CUT, 0).astype(np.uint8))
    material = Material(E, 0.3, 1000.0, 0.0, 1e-3 if fixed else 0.0)
    stepping = TimeStepping('symplectic_euler', safety=0.8 if fixed else 0.2)
    weight = (G * np.sin(angle), 0.0, -G * np.cos(angle)) if fixed else (0.0, 0.0, 0.0)
    return Dynamics(mesh, material, 'linear', stepping, None, weight, friction), len(low)


@pytest.mark.parametrize('slope', [0.2, 0.35, 0.45])
def test_a_block_on_a_slope_sticks_or_slides_as_coulomb_says(slope: float) -> None:
    friction, angle = 0.3, np.arctan(slope)
    dynamics, first = inclined(friction, angle)
    mass, speeds = dynamics.model.mass[first:], []
    for _ in range(15):
        assert not dynamics.advance(Coupling()).trouble
        speeds.append(mass @ dynamics.velocity[first:, 0] / mass.sum())
    slides = slope > friction
    exact = G * (np.sin(angle) - friction * np.cos(angle)) if slides else 0.0
    assert (speeds[-1] - speeds[7]) / (7 / 30) == pytest.approx(exact, abs=0.002 * G)
    if slides:
        way = mass @ dynamics.displacement[first:, 0] / mass.sum()
        rubbed = friction * mass.sum() * G * np.cos(angle) * way
        assert dynamics.cut_contact.lost == pytest.approx(rubbed, rel=0.01)
    else:
        assert abs(speeds[-1]) < 1e-6


def test_faces_that_meet_keep_momentum_and_lose_energy() -> None:
    """Without damping, what the two pieces have less after they met is what contact has lost."""
    dynamics, first = inclined(0.3, 0.0, fixed=False)
    mass = dynamics.model.mass
    dynamics.velocity[first:] = [0.05, 0.02, -0.1]
    momentum = mass @ dynamics.velocity
    before = 0.5 * mass[first:].sum() * 0.0129
    dynamics.restart()
    least = np.inf
    for _ in range(4):
        motion = dynamics.advance(Coupling())
        assert not motion.trouble
        np.testing.assert_allclose(mass @ dynamics.velocity, momentum, rtol=1e-9)
        least = motion.kinetic_energy + motion.elastic_energy
    assert dynamics.cut_contact.lost > 0.01 * before
    assert least + dynamics.cut_contact.lost == pytest.approx(before, rel=0.01)


def test_what_does_not_meet_moves_as_without_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    def moved() -> bytes:
        bar = Dynamics(parted(gap=2e-3), Material(E, 0.3, 1000.0, 1.0, 2e-4))
        bar.velocity[bar.mesh.rest[:, 1] > 0.004, 1] = 0.01
        for _ in range(5):
            bar.advance(Coupling())
        return bar.displacement.tobytes()

    found = moved()
    monkeypatch.setattr(cut_contact.CutContact, 'possible', property(lambda own: False))
    assert moved() == found


def test_contact_goes_on_bit_for_bit_from_a_state() -> None:
    material, resistance = Material(E, 0.3, 1000.0, 5.0, 2e-4), Resistance(1.0, 1.0, 1.0)
    one = TissueSimulation(parted(), material, resistance, friction=Friction(0.3))
    one.velocity[one.mesh.rest[:, 0] > LENGTH / 2] = [-0.1, 0.05, 0.0]
    one.velocity[one.mesh.fixed == 1] = 0.0
    one.dynamics.restart()
    for _ in range(3):
        one.frame(None)
    assert one.dynamics.cut_contact.lost > 0.0
    other = from_state(state_of(one))
    for _ in range(3):
        one.frame(None)
        other.frame(None)
    assert other.displacement.tobytes() == one.displacement.tobytes()
    assert other.dynamics.cut_contact.lost == one.dynamics.cut_contact.lost
