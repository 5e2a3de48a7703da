"""Each piece that comes off is told once, with its volume."""

from copy import deepcopy
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from meshes import irregular_box
from strokes import draw, method_named, straight

from bench.cuts.loose_pieces import counted
from cutting_trainer.tissue_sim.contact.coupling import Coupling
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.pieces import PieceRegister, free_parts, pieces_of
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.node import TissueSimNode

SIZE = np.array([0.06, 0.06, 0.012])
UP = (0.0, 0.0, 0.020)
SIDES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


def held_at_its_sides() -> TetMesh:
    nodes, tets = irregular_box((15, 15, 3), 0.004, 3)
    nodes = nodes - [SIZE[0] / 2, SIZE[1] / 2, 0.0]
    return TetMesh(nodes, tets, (np.abs(nodes[:, 0]) > 0.0299).astype(np.uint8))


def excise(mesh, centre, half, angle):
    """Cut around a square prism by four straight strokes; return its volume at rest [m^3]."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for side in SIDES:
        along = turn @ [-side[1], side[0]] * half * 1.25
        middle = np.asarray(centre) + turn @ side * half
        begin, end = ([*(middle + s * along), -0.004] for s in (-1, 1))
        draw(method_named(), mesh, straight(begin, end, UP, 12))
    return 4 * half**2 * SIZE[2]


@cache
def _excised() -> TetMesh:
    mesh = held_at_its_sides()
    excise(mesh, (0.0, 0.0), 0.01, 0.3)
    return mesh


def with_plug() -> TetMesh:
    """Tissue with a square plug cut out of its middle."""
    return deepcopy(_excised())


@pytest.mark.long
@pytest.mark.parametrize(
    'seed', [pytest.param(n, marks=pytest.mark.thorough if n else ()) for n in range(6)]
)
def test_a_square_plug_is_told_once_with_its_volume(seed):
    rng = np.random.default_rng(seed)
    mesh = held_at_its_sides()
    register = PieceRegister(mesh)
    centre, half = rng.uniform(-0.008, 0.008, 2), rng.uniform(0.008, 0.011)
    volume = excise(mesh, centre, half, rng.uniform(0, np.pi))
    (piece,) = register.find_new(mesh, mesh.rest)
    assert piece.number == 1
    assert piece.volume == pytest.approx(volume, rel=0.01)
    assert [piece.volume] == pytest.approx(list(counted(mesh).values()), rel=1e-9)
    assert piece.position == pytest.approx([*centre, SIZE[2] / 2], abs=2e-4)
    assert register.find_new(mesh, mesh.rest) == []
    draw(method_named(), mesh, straight([-0.028, 0.025, 0.006], [0.0, 0.025, 0.006], UP, 8))
    assert register.find_new(mesh, mesh.rest) == []


@pytest.mark.long
def test_the_smaller_half_of_a_piece_is_new():
    mesh = held_at_its_sides()
    register = PieceRegister(mesh)
    excise(mesh, (0.0, 0.0), 0.0097, 0.0)
    (whole,) = register.find_new(mesh, mesh.rest)
    draw(method_named(), mesh, straight([0.005, -0.013, -0.004], [0.005, 0.013, -0.004], UP, 12))
    (new,) = register.find_new(mesh, mesh.rest)
    assert (whole.number, new.number) == (1, 2)
    assert new.volume == pytest.approx(whole.volume * (0.0097 - 0.005) / 0.0194, rel=0.01)
    assert new.position[0] > 0.005
    both = pieces_of(mesh, mesh.rest)
    assert sum(piece.volume for piece in both) == pytest.approx(whole.volume, rel=1e-9)


def test_pieces_that_were_there_before_are_not_new():
    mesh = with_plug()
    assert PieceRegister(mesh).find_new(mesh, mesh.rest) == []


def test_the_node_tells_a_piece_with_its_mass_once_the_blade_is_out():
    mesh, told = with_plug(), []
    node = SimpleNamespace(
        _simulation=SimpleNamespace(mesh=mesh, material=SimpleNamespace(density=1060.0)),
        _pieces=PieceRegister(held_at_its_sides()),
        _looked_at=0,
        _free_pieces=SimpleNamespace(publish=told.append),
    )
    node._simulation.positions = mesh.rest + 0.1
    for blade in (object(), None, None):
        node._simulation.blade = blade
        TissueSimNode._tell_pieces(node, SimpleNamespace(step=7))
        assert len(told) == (blade is None)
    (message,) = told
    assert (message.number, message.step, message.topology) == (1, 7, mesh.topology)
    assert message.mass == pytest.approx(1060.0 * 4e-4 * SIZE[2], rel=0.01)
    assert message.position == pytest.approx([0.1, 0.1, 0.1 + SIZE[2] / 2], abs=2e-4)


def test_attached_tissue_and_unused_nodes_are_no_pieces():
    corners = np.vstack([np.zeros(3), np.eye(3), [[5.0, 5.0, 5.0]]])
    tissue = TetMesh(corners[:4], np.array([[0, 1, 2, 3]]), np.array([1, 0, 0, 0], np.uint8))
    assert free_parts(tissue).tolist() == [0, 0, 0, 0]
    tissue.fixed[:] = 0
    assert free_parts(tissue).tolist() == [1, 1, 1, 1]


def test_a_cut_may_take_nodes_back():
    mesh = with_plug()
    register = PieceRegister(mesh)
    used = int(mesh.tetrahedra.max()) + 1
    longer = SimpleNamespace(
        rest=np.vstack([mesh.rest, np.zeros((3, 3))]),
        tetrahedra=mesh.tetrahedra,
        fixed=np.append(mesh.fixed, np.zeros(3, np.uint8)),
    )
    assert used == len(mesh.rest)
    assert register.find_new(longer, longer.rest) == []
    assert register.find_new(mesh, mesh.rest) == []


def pushed_plug(gravity=(0.0, 0.0, 0.0)):
    """Hardly damped tissue, and the nodes of a plug in it that was pushed out at 0.2 m/s."""
    mesh = with_plug()
    material = Material(2000.0, 0.3, 1060.0, 0.1, 2e-4)
    stepping = TimeStepping('symplectic_euler', max_substeps=10000)
    dynamics = Dynamics(mesh, material, 'linear', stepping, ActiveSettings('on'), gravity)
    dynamics.resume(np.zeros_like(mesh.rest))
    loose = free_parts(mesh) > 0
    dynamics.velocity[loose] = [0.0, 0.0, 0.2]
    dynamics.restart()
    return dynamics, loose


@pytest.mark.thorough
@pytest.mark.long
def test_a_loose_piece_comes_to_rest_within_two_seconds_and_costs_nothing_then():
    dynamics, loose = pushed_plug()
    for _ in range(60):
        dynamics.advance(Coupling())
    assert not dynamics.velocity[loose].any()
    assert 0.005 < dynamics.displacement[loose, 2].mean() < 0.03
    assert np.abs(dynamics.displacement[~loose]).max() < 1e-5
    for _ in range(50):  # the hole that it slid out of rings on: the tissue is hardly damped
        dynamics.advance(Coupling())
    assert dynamics.active_nodes == 0


def test_a_loose_piece_falls_under_its_weight():
    dynamics, loose = pushed_plug(gravity=(0.0, 0.0, -9.81))
    dynamics.velocity[:] = 0.0
    dynamics.restart()
    for _ in range(3):
        dynamics.advance(Coupling())
    assert dynamics.displacement[loose, 2].mean() == pytest.approx(-9.81 * 0.1**2 / 2, rel=0.03)
