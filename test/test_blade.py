"""The blade in the tissue: what it costs to move it, and that tension opens what it has cut."""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from meshes import box

from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.blade import Resistance, Sweep, points_of
from cutting_trainer.tissue_sim.contact.immersion import (
    POINTS,
    Edge,
    Tissue,
    immerse,
    rest_length,
)
from cutting_trainer.tissue_sim.contact.tool import ContactState, CutCommand, Frame, ToolContact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.locate import barycentric, find_tetrahedra
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

pytestmark = pytest.mark.long

TOUGHNESS, RATE = 40.0, 500.0


def block(stretch: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TissueSimulation:
    nodes, tets = box((12, 6, 4), 0.005)
    return TissueSimulation(
        TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
        Material(5000.0, 0.4, 1000.0, 5.0, 1e-3),
        Resistance(0.05, TOUGHNESS, 0.0),
        stepping=TimeStepping(rate=RATE),
        stretch=stretch,
    )


def contact_at(simulation: TissueSimulation, tip: np.ndarray) -> ToolContact:
    """A tip over, at or under a place of the flat top, as the bridge would report it."""
    mesh, at = simulation.mesh, np.array([*tip[:2], 0.02])
    corners = mesh.rest[mesh.triangles]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    flat = np.flatnonzero((corners[:, :, 2] > 0.0199).all(axis=1))
    across = edges[flat].transpose(0, 2, 1)
    from_first = (at - corners[flat, 0])[:, :, None]
    shares = np.linalg.solve(across @ edges[flat], across @ from_first)[:, :, 0]
    weights = np.column_stack([1 - shares.sum(axis=1), shares])
    best = int(np.argmax(weights.min(axis=1)))
    return ToolContact(
        state=ContactState.TOUCHING if tip[2] < 0.02 else ContactState.NONE,
        topology=mesh.topology,
        nodes=mesh.triangles[flat[best]].astype(np.int64),
        weights=np.clip(weights[best], 0, 1) / np.clip(weights[best], 0, 1).sum(),
        device=tip + np.array([0, 0, 0.001]),
        offset=np.array([0, 0, 0.001]),
        normal=np.array([0.0, 0, 1]),
        stiffness=400.0,
        radius=0.001,
        blade_root=tip + np.array([0, 0, 0.03]),
        blade_tip=tip,
    )


def draw(simulation: TissueSimulation, tips: np.ndarray) -> Iterator[Frame]:
    """Draws a vertical blade of 3 cm along a path of its tip; yields the frames."""
    for tip in tips:
        yield simulation.frame(contact_at(simulation, tip))


def area_in_tissue(last: Sweep, sweep: Sweep) -> float:
    """Area from the end of the last sweep to that of the next, over the lowest 10 of the 30 mm of
    the edge [m^2].
    """
    before = last.tip_to + (last.root_to - last.tip_to) / 3
    after = sweep.tip_to + (sweep.root_to - sweep.tip_to) / 3
    return Sweep(before, last.tip_to, after, sweep.tip_to).area


def path(*corners: tuple[float, float, float], speed: float = 0.04) -> np.ndarray:
    points = [np.array([corners[0]])]
    for a, b in itertools.pairwise(corners):
        steps = int(np.linalg.norm(np.subtract(b, a)) / speed * RATE)
        points.append(np.linspace(a, b, steps + 1)[1:])
    return np.concatenate(points)


def test_the_blade_moves_on_only_at_toughness_times_immersed_length() -> None:
    simulation = block()
    tips = path((0.012, 0.015, 0.021), (0.012, 0.015, 0.01), (0.05, 0.015, 0.01))
    forces, limits = [], []
    for frame in draw(simulation, tips):
        if frame.command == CutCommand.ADVANCE:
            simulation.cut_done()
        forces.append(np.linalg.norm(frame.force))
        limits.append(frame.resistance)
    assert simulation.state == ContactState.INSIDE
    # 10 mm deep at 40 J/m^2: 0.4 N, and it never pulls harder than that.
    assert np.median(limits[-200:]) == pytest.approx(TOUGHNESS * 0.010, rel=0.1)
    assert np.median(forces[-200:]) == pytest.approx(np.median(limits[-200:]), rel=0.05)


def test_the_area_that_is_asked_for_is_the_area_that_is_swept_and_sweeps_join() -> None:
    simulation = block()
    tips = path((0.012, 0.015, 0.021), (0.012, 0.015, 0.01), (0.045, 0.015, 0.01))
    sweeps = []
    steps = []
    for frame in draw(simulation, tips):
        if frame.command == CutCommand.ADVANCE:
            steps.append(frame.step)
            sweeps.append(frame.sweep)
            simulation.cut_done()
    # Before, the blade goes in, and drags the tissue along until it yields.
    steady = [sweep for step, sweep in zip(steps, sweeps, strict=True) if step > 300]
    swept = steady[-1].tip_to[0] - steady[0].tip_to[0]
    assert swept > 0.015
    asked = sum(area_in_tissue(*pair) for pair in itertools.pairwise(steady))
    assert asked == pytest.approx(swept * 0.01, rel=0.02)
    joints = [
        np.linalg.norm(sweeps[i].tip_to - sweeps[i + 1].tip_from)
        for i in range(20, len(sweeps) - 1)
        if steps[i + 1] == steps[i] + 1
    ]
    assert len(joints) > 100
    # From frame to frame the tissue carries the cut's end along, a little.
    assert max(joints) < 1e-4


def test_a_blade_that_is_lifted_out_is_let_go_and_the_cut_is_finished_once() -> None:
    simulation = block()
    tips = path(
        (0.02, 0.015, 0.021), (0.02, 0.015, 0.012), (0.03, 0.015, 0.012), (0.03, 0.015, 0.04)
    )
    commands = []
    for frame in draw(simulation, tips):
        if frame.command is not None:
            commands.append(frame.command)
            simulation.cut_done()
    assert commands.count(CutCommand.FINISH) == 1
    assert commands[-1] == CutCommand.FINISH
    assert simulation.state == ContactState.NONE


def test_a_sweep_that_was_not_cut_is_asked_for_again() -> None:
    simulation = block()
    tips = path((0.012, 0.015, 0.021), (0.012, 0.015, 0.01), (0.04, 0.015, 0.01))
    sweeps = []
    for frame in draw(simulation, tips):
        if frame.command == CutCommand.ADVANCE:
            sweeps.append(frame.sweep)
            simulation.cut_failed()
    # The tissue, and where the cut begins in it, follow the blade by a few millimetres.
    assert all(np.linalg.norm(s.tip_from - sweeps[0].tip_from) < 8e-3 for s in sweeps)
    assert sweeps[-1].area > 5 * sweeps[0].area


def test_after_a_failure_the_sweep_begins_an_element_before_and_no_farther_at_the_next() -> None:
    simulation = block()
    tips = path((0.012, 0.015, 0.021), (0.012, 0.015, 0.01), (0.045, 0.015, 0.01))
    starts = []
    for frame in draw(simulation, tips):
        if frame.command == CutCommand.ADVANCE:
            starts.append((frame.step, frame.sweep.tip_from[0]))
            if frame.step < 350 or frame.step > 360:
                simulation.cut_done()
            else:
                simulation.cut_failed()
    before, first, last = (next(x for k, x in starts if k >= step) for step in (350, 351, 360))
    element = 2 * np.cbrt(0.005**3 / 6)
    assert before - first == pytest.approx(element, abs=0.6e-3)
    assert last == pytest.approx(first, abs=0.3e-3)
    assert next(x for k, x in starts if k >= 363) > before


def test_blade_that_goes_back_in_its_cut_pays_nothing_until_it_is_at_the_front_again() -> None:
    simulation = block()
    front, back = (0.035, 0.015, 0.01), (0.023, 0.015, 0.01)
    way_there = path((0.012, 0.015, 0.021), (0.012, 0.015, 0.01), front)
    for frame in draw(simulation, way_there):
        if frame.command == CutCommand.ADVANCE:
            simulation.cut_done()
    assert frame.resistance == pytest.approx(TOUGHNESS * 0.01, rel=0.1)
    forces = []
    for frame in draw(simulation, path(front, back, front, (0.04, 0.015, 0.01))):
        if frame.command == CutCommand.ADVANCE:
            simulation.cut_done()
        forces.append(np.linalg.norm(frame.force))
    free = np.flatnonzero(np.array(forces) < 0.1 * TOUGHNESS * 0.01)
    # 0.08 mm a frame; the tissue and the spring relax over the first 7 of the 12 mm.
    assert 2 * 4.5e-3 < len(free) * 8e-5 < 2 * 7e-3
    assert np.median(forces[-30:]) == pytest.approx(TOUGHNESS * 0.01, rel=0.1)


def test_the_length_at_rest_counts_tissue_as_it_was_and_no_gap_between_two_pieces() -> None:
    nodes, tets = box((2, 2, 2), 0.005)
    apart = nodes + np.array([0.0, 0.0, 0.02])
    mesh = TetMesh(np.concatenate([nodes, apart]), np.concatenate([tets, tets + len(nodes)]))
    positions = mesh.rest * np.array([1.0, 1.0, 0.8])
    positions[len(nodes) :, 2] += 0.01
    tip = np.array([0.0041, 0.0052, -0.001])
    points = points_of(tip + np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.0]]))
    edge = Edge(
        points.copy(),
        np.zeros((POINTS, 4), np.int64),
        np.zeros((POINTS, 4)),
        np.zeros(POINTS),
        np.zeros(1, np.int64),
        np.zeros(POINTS, np.int64),
        np.zeros(2),
    )
    near, opened = np.arange(len(mesh.tetrahedra)), np.zeros((0, 3), np.int32)
    of = mesh.tetrahedra, mesh.neighbors, near, opened, mesh.regions
    tissue = Tissue(positions, mesh.rest, *of)
    immerse(edge, points, tissue)
    inside = edge.spans > 0.0
    assert inside.any() and not inside[np.flatnonzero(inside)[0] : np.flatnonzero(inside)[-1]].all()
    assert rest_length(edge, tissue) == pytest.approx(1 / 0.8, rel=1e-9)


def test_below_the_threshold_the_blade_does_not_go_in() -> None:
    simulation = block()
    for frame in draw(simulation, path((0.02, 0.015, 0.021), (0.02, 0.015, 0.0199), speed=0.01)):
        assert frame.command is None
    assert simulation.state == ContactState.TOUCHING


def test_stretch_puts_the_tissue_in_tension_and_in_equilibrium() -> None:
    simulation = block((0.0, 0.05, 0.0))
    u = simulation.displacement
    fixed = simulation.mesh.fixed == 1
    expected = (simulation.mesh.rest[fixed] - simulation.mesh.rest[fixed].mean(axis=0)) * [
        0,
        0.05,
        0,
    ]
    np.testing.assert_allclose(u[fixed], expected, atol=1e-15)
    force = simulation.model.force(u)
    assert np.abs(force[~fixed]).max() < 1e-9 * np.abs(force).max()
    before = u.copy()
    frame = simulation.frame(None)
    assert frame.kinetic_energy < 1e-12 * frame.elastic_energy
    np.testing.assert_allclose(simulation.displacement, before, atol=1e-9)


def test_a_bridge_that_is_disabled_in_the_cut_makes_the_tissue_let_go_and_finish() -> None:
    simulation = block()
    tips = path((0.012, 0.015, 0.021), (0.012, 0.015, 0.01), (0.03, 0.015, 0.01))
    for frame in draw(simulation, tips):
        if frame.command is not None:
            simulation.cut_done()
    assert simulation.state == ContactState.INSIDE
    silent = replace(contact_at(simulation, tips[-1]), state=ContactState.NONE)
    frame = simulation.frame(silent)
    assert simulation.state == ContactState.NONE
    assert frame.command == CutCommand.FINISH
    simulation.cut_done()
    assert not simulation.frame(silent).force.any()


def test_a_frame_that_diverges_is_taken_back_and_the_tool_is_let_go() -> None:
    simulation = block()
    for _ in draw(simulation, path((0.012, 0.015, 0.021), (0.012, 0.015, 0.0195))):
        pass
    before = simulation.displacement.copy()
    assert before.any()
    simulation.velocity[:] = 1e6
    frame = simulation.frame(contact_at(simulation, np.array([0.012, 0.015, 0.0195])))
    assert frame.diverged
    assert not frame.force.any()
    assert np.array_equal(simulation.displacement, before)
    assert not simulation.velocity.any()
    after = [simulation.frame(None) for _ in range(50)]
    assert not any(f.diverged for f in after)
    assert after[-1].elastic_energy < after[0].elastic_energy


def test_points_of_an_edge_are_found_where_a_look_at_every_element_finds_them() -> None:
    """An edge that sticks out of the tissue, whose upper points lie in no element."""
    nodes, tets = box((6, 5, 4), 0.005)
    random = np.random.default_rng(4)
    mesh = TetMesh(nodes + random.uniform(-4e-4, 4e-4, nodes.shape), tets)
    for _ in range(20):
        low = random.uniform(0.0, [0.03, 0.025, 0.02])
        points = low + np.linspace(0.0, 1.0, 24)[:, None] * np.array([0.004, -0.003, 0.02])
        found, weights = find_tetrahedra(mesh.rest, mesh.tetrahedra, mesh.neighbors, points)
        out = np.empty(4)
        for point, tet, weight in zip(points, found, weights, strict=True):
            least = [
                barycentric(mesh.rest, mesh.tetrahedra, k, point, out) for k in range(len(tets))
            ]
            assert (tet >= 0) == (max(least) >= -1e-9)
            if tet >= 0:
                assert least[tet] >= -1e-9
                np.testing.assert_allclose(weight @ mesh.rest[mesh.tetrahedra[tet]], point)


@pytest.mark.parametrize('scene', ['circle', 'excision'])
def test_a_thin_sheet_under_tension_begins_at_rest(scene: str) -> None:
    simulation, _ = make_simulation(load_scene(scene).tissue)
    before = simulation.displacement.copy()
    simulation.frame(None)
    np.testing.assert_allclose(simulation.displacement, before, atol=1e-9)
