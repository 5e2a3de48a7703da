"""Two tools in one tissue: each feels the other through it, one holds what the other cuts."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box

from bench.figures.arms_energy import STIFFNESS, TOP, accounts, contact_of
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.session.in_process import Tissue
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.tool import (
    MAX_PULL_N,
    ContactState,
    Frame,
    ToolContact,
    ToolMode,
)
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state import from_state, state_of

pytestmark = pytest.mark.long

UP, ALONG = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def block(
    tools: int = 2,
    integrator: IntegratorName = 'symplectic_euler',
    active: ActiveSettings | None = None,
    modulus: float = 5000.0,
    threshold: float = 0.5,
) -> TissueSimulation:
    """A soft block, fixed at its underside, whose points are loaded by triangle."""
    nodes, tets = box((12, 6, 4), 0.005)
    return TissueSimulation(
        TetMesh(nodes, tets, nodes[:, 2] < 1e-9),
        Material(modulus, 0.4, 1000.0, 40.0, 2e-3),
        Resistance(threshold, 8.0, 0.0),
        stepping=TimeStepping(integrator, rate=100.0),
        active=active,
        contact='triangle',
        tools=tools,
    )


def at_node(simulation: TissueSimulation, x: float, y: float, z: float) -> ToolContact:
    """The contact of a tool at a node of the flat top, with its tip at a height z [m]."""
    mesh = simulation.mesh
    node = int(np.linalg.norm(mesh.rest - [x, y, TOP], axis=1).argmin())
    tip = np.array([*mesh.rest[node, :2], z])
    return replace(contact_of(mesh, tip), mode=ToolMode.PALPATOR)


def grasper(contact: ToolContact, *, closed: bool) -> ToolContact:
    """The same tool as a grasper."""
    return replace(contact, mode=ToolMode.CLOSED_GRASPER if closed else ToolMode.OPEN_GRASPER)


def rest_under(simulation: TissueSimulation, *contacts: ToolContact, frames: int = 150) -> Frame:
    """The last of many frames under the same contacts."""
    for _ in range(frames):
        frame = simulation.frame(*contacts)
    return frame


def statics(simulation: TissueSimulation, depths: dict[int, float]) -> dict[int, float]:
    """Forces [N] on tools that press single nodes, by a dense solution of statics.

    Args:
        simulation: of a linear model.
        depths: of the tools below the surface at rest [m], by node.
    """
    model, mesh = simulation.model, simulation.mesh
    free = np.repeat(mesh.fixed == 0, 3)
    stiffness, load = model.dense(), np.zeros(3 * mesh.node_count)
    for node, depth in depths.items():
        stiffness[3 * node + 2, 3 * node + 2] += STIFFNESS
        load[3 * node + 2] -= STIFFNESS * depth
    u = np.zeros(3 * mesh.node_count)
    u[free] = np.linalg.solve(stiffness[np.ix_(free, free)], load[free])
    return {node: STIFFNESS * (depth + u[3 * node + 2]) for node, depth in depths.items()}


@pytest.mark.parametrize('integrator', ['symplectic_euler', 'rk4', 'implicit'])
def test_each_tool_feels_the_other_as_statics_demands(integrator: IntegratorName) -> None:
    simulation = block(integrator=integrator)
    deep, beside = (at_node(simulation, x, 0.015, TOP - d) for x, d in ((0.03, 3e-3), (0.04, 1e-3)))
    frame = rest_under(simulation, deep, beside)
    both = statics(simulation, {int(deep.nodes[0]): 3e-3, int(beside.nodes[0]): 1e-3})
    alone = statics(simulation, {int(beside.nodes[0]): 1e-3})
    felt = [one.force[2] for one in frame.by_tool]
    assert felt == pytest.approx(list(both.values()), rel=2e-3)
    # The dent of the first tool has taken the tissue away from under the second one.
    assert felt[1] < 0.8 * next(iter(alone.values()))
    assert [one.tool for one in frame.by_tool] == [0, 1]


def test_two_tools_on_one_node_share_its_force() -> None:
    simulation = block()
    contact = at_node(simulation, 0.03, 0.015, TOP - 2e-3)
    frame = rest_under(simulation, contact, contact)
    forces = [one.force[2] for one in frame.by_tool]
    assert forces[0] == pytest.approx(forces[1], rel=1e-9)
    model, node = simulation.model, int(contact.nodes[0])
    inner = -model.force(simulation.displacement)[node, 2]
    assert sum(forces) == pytest.approx(inner, rel=5e-3)


def test_a_tool_that_never_came_changes_no_bit() -> None:
    one, two = block(tools=1), block(tools=2)
    for k in range(40):
        contact = at_node(one, 0.03, 0.015, TOP + 1e-3 - 1e-4 * k)
        first, second = one.frame(contact), two.frame(contact)
        assert first.felt == second.felt
        assert not second.others[0].force.any()
    np.testing.assert_array_equal(one.displacement, two.displacement)


def test_more_contacts_than_tools_are_refused() -> None:
    with pytest.raises(ValueError, match='2 contacts for 1 tools'):
        block(tools=1).frame(None, None)


@pytest.mark.thorough
def test_far_nodes_move_with_both_tools_where_only_the_near_ones_are_awake() -> None:
    """Nodes sleep away from the tools: with two, both have awake nodes around them."""
    settings = ActiveSettings('on', tolerance=1e-4)
    asleep, awake = block(active=settings), block()
    touches = [(0.01, 0.015, TOP - 2e-3), (0.05, 0.015, TOP - 1e-3)]
    contacts = [at_node(awake, *place) for place in touches]
    some, every = (rest_under(simulation, *contacts) for simulation in (asleep, awake))
    for one, other in zip(some.by_tool, every.by_tool, strict=True):
        assert one.force[2] == pytest.approx(other.force[2], rel=0.02)


def test_a_grasper_lifts_what_it_has_closed_on_and_lets_go() -> None:
    simulation = block()
    over = at_node(simulation, 0.03, 0.015, TOP - 1e-3)
    pressed = rest_under(simulation, grasper(over, closed=False))
    assert pressed.state == ContactState.TOUCHING
    assert pressed.force[2] > 0.01
    closed = simulation.frame(grasper(over, closed=True))
    held = simulation.frame(grasper(over, closed=True))
    assert held.state == ContactState.INSIDE
    assert abs(held.force - pressed.force).max() < 0.01 * pressed.force[2], 'the force jumps'
    assert closed.state == ContactState.INSIDE
    node = int(over.nodes[0])
    before = simulation.positions[node, 2]
    for k in range(1, 61):
        lifted = replace(over, device=over.device + 1e-4 * k * UP)
        frame = simulation.frame(grasper(lifted, closed=True))
    frame = rest_under(simulation, grasper(lifted, closed=True))
    assert frame.force[2] < -0.05, 'the tissue pulls the hand down'
    assert simulation.positions[node, 2] > before + 2e-3
    sideways = grasper(replace(lifted, device=lifted.device + 4e-3 * ALONG), closed=True)
    assert rest_under(simulation, sideways).force[0] < -0.02
    opened = simulation.frame(grasper(lifted, closed=False))
    assert opened.state == ContactState.NONE or opened.force[2] >= 0.0
    away = replace(lifted, state=ContactState.NONE)
    assert not rest_under(simulation, grasper(away, closed=False)).force.any()


def test_tissue_that_is_pulled_too_hard_slips_out_of_the_jaws() -> None:
    simulation = block(modulus=50_000.0)
    over = replace(at_node(simulation, 0.03, 0.015, TOP - 1e-3), radius=0.01)
    simulation.frame(grasper(over, closed=False))
    pulls = []
    for k in range(120):
        lifted = replace(over, device=over.device + 5e-4 * k * UP)
        if k:
            lifted = replace(lifted, state=ContactState.NONE)
        pulls.append(np.linalg.norm(simulation.frame(grasper(lifted, closed=True)).force))
    assert 0.8 * MAX_PULL_N < max(pulls) <= MAX_PULL_N * (1 + 1e-9)
    assert pulls[-1] == 0.0
    assert simulation.state == ContactState.NONE


def test_jaws_that_close_in_the_air_hold_nothing_until_they_close_on_tissue() -> None:
    simulation = block()
    above, touching = (at_node(simulation, 0.03, 0.015, TOP + z) for z in (1e-3, -1e-3))
    frame = rest_under(simulation, grasper(above, closed=True), frames=3)
    assert frame.state == ContactState.NONE
    assert not frame.force.any()
    assert rest_under(simulation, grasper(touching, closed=True)).state == ContactState.TOUCHING
    simulation.frame(grasper(touching, closed=False))
    assert simulation.frame(grasper(touching, closed=True)).state == ContactState.INSIDE


def test_jaws_keep_what_they_press_down_however_hard() -> None:
    simulation = block(modulus=50_000.0)
    over = at_node(simulation, 0.03, 0.015, TOP - 1e-3)
    simulation.frame(grasper(over, closed=True))
    deep = replace(over, device=over.device - 4e-3 * UP)  # four radii, more than a pull may be
    assert rest_under(simulation, grasper(deep, closed=True)).state == ContactState.INSIDE


def test_jaws_of_which_nothing_is_known_any_more_let_go_for_good() -> None:
    simulation = block()
    over = at_node(simulation, 0.03, 0.015, TOP - 1e-3)
    simulation.frame(grasper(over, closed=False))
    lifted = grasper(replace(over, device=over.device + 4e-3 * UP), closed=True)
    lifted = replace(lifted, state=ContactState.NONE)
    simulation.frame(grasper(over, closed=True))
    assert simulation.frame(lifted).state == ContactState.INSIDE
    assert simulation.frame(None).state == ContactState.NONE
    # A bridge that comes back with closed jaws pulls at nothing, wherever they are by then.
    back = simulation.frame(lifted)
    assert back.state == ContactState.NONE
    assert not back.force.any()


def test_a_grip_follows_its_nodes_when_others_are_removed() -> None:
    simulation = block()
    mesh = simulation.mesh
    corner = int(np.linalg.norm(mesh.rest - [0.06, 0.03, TOP], axis=1).argmin())
    held = replace(at_node(simulation, 0.06, 0.03, TOP - 1e-3), nodes=np.array([corner]))
    simulation.frame(None, grasper(held, closed=True))
    place = mesh.rest[simulation.tools[1]._grip.nodes[0]].copy()
    for node in (0, int(mesh.tetrahedra[0, 1])):
        star = np.sort(mesh.star(node))[::-1].astype(np.int64)
        simulation.apply_cut(TopologyDelta(removed_tetrahedra=star))
    grip = simulation.tools[1]._grip
    np.testing.assert_array_equal(mesh.rest[grip.nodes[0]], place)
    assert simulation.frame(None, grasper(held, closed=True)).others[0].state == ContactState.INSIDE


def cut_beside_a_lifted_lip(*, cuts: bool) -> tuple[Tissue, list[Frame]]:
    """One tool holds and lifts the surface; the other cuts 7 mm beside it, and leaves."""
    tissue = Tissue(block(threshold=0.05), make_method(CuttingSettings()))
    simulation, frames = tissue.simulation, []
    held = at_node(simulation, 0.04, 0.015, TOP - 1e-3)
    for k in range(300):
        lifted = replace(held, device=held.device + 8e-3 * np.clip((k - 20) / 40, 0.0, 1.0) * UP)
        x, y = 0.0325, np.interp(k, [90, 180], [-0.005, 0.035])
        depth = np.interp(k, [60, 90, 190, 220], [-1e-3, 0.012, 0.012, -0.03])
        tip = np.array([x, y, TOP - depth])
        blade = replace(
            at_node(simulation, *tip),
            device=tip,
            blade_tip=tip,
            blade_root=tip + 0.03 * UP,
            mode=ToolMode.SCALPEL,
        )
        frames.append(tissue.frame(blade if cuts else None, grasper(lifted, closed=k > 10)))
    return tissue, frames


def test_a_cut_beside_a_lifted_lip_is_felt_in_the_hand_that_holds_it() -> None:
    (uncut, before), (cut, after) = (cut_beside_a_lifted_lip(cuts=c) for c in (False, True))
    assert uncut.simulation.elements_cut == 0
    assert cut.simulation.elements_cut > 20
    assert after[-1].state == ContactState.NONE
    assert after[-1].others[0].state == ContactState.INSIDE
    pulled, freed = (-frames[-1].others[0].force[2] for frames in (before, after))
    assert pulled > 0.1
    assert freed < 0.98 * pulled, 'a lip that is cut free pulls less'
    lip = np.linalg.norm(cut.simulation.mesh.rest - [0.04, 0.015, TOP], axis=1).argmin()
    assert cut.simulation.positions[lip, 2] > uncut.simulation.positions[lip, 2], 'and rises'


def test_only_one_blade_is_in_the_tissue_at_a_time() -> None:
    tissue = Tissue(block(threshold=0.05), make_method(CuttingSettings()))
    simulation = tissue.simulation
    states = []
    for k in range(120):
        depth = np.interp(k, [0, 20, 80, 100], [-1e-3, 5e-3, 5e-3, -8e-3])
        first, second = (
            replace(at_node(simulation, x, 0.015, TOP - d), mode=ToolMode.SCALPEL)
            for x, d in ((0.015, depth), (0.045, np.interp(k, [20, 40], [-1e-3, 5e-3])))
        )
        frame = tissue.frame(first, second)
        states.append([one.state for one in frame.by_tool])
    inside = (np.array(states) == ContactState.INSIDE).tolist()
    assert any(first for first, _ in inside)
    assert any(second for _, second in inside)
    assert not any(first and second for first, second in inside)


def test_a_session_with_two_tools_goes_on_from_its_state_with_the_same_bits() -> None:
    simulation = block()
    over = at_node(simulation, 0.03, 0.015, TOP - 1e-3)
    other = at_node(simulation, 0.045, 0.015, TOP - 2e-3)
    rest_under(simulation, grasper(over, closed=True), other, frames=10)
    twin = from_state(state_of(simulation))
    for k in range(20):
        moved = replace(over, device=over.device + 1e-4 * k * UP)
        contacts = grasper(moved, closed=True), other
        frames = [s.frame(*contacts).by_tool for s in (simulation, twin)]
        assert [one.felt for one in frames[0]] == [one.felt for one in frames[1]]
        assert frames[0][0].state == ContactState.INSIDE


def test_the_work_of_both_tools_is_stored_lost_or_paid_for_the_cut() -> None:
    found = accounts(rate=500.0)
    lifted, cut, end = found.lifted, found.cut, found.end
    assert abs(lifted.off) < 1e-4  # it holds the tissue, and nothing is cut yet
    assert lifted.stored > 0.9 * lifted.work[1] > 5e-4
    assert cut.paid > 5e-3
    # Of losses in a frame of 2 ms a part is not seen; `bench.figures arms` takes shorter frames.
    assert max(abs(cut.off), abs(end.off)) < 0.02
    assert end.stored < 1e-6
    # Either tool's work alone does not account for it.
    assert abs(cut._replace(work=(cut.work[0], 0.0)).off) > 0.05
    assert abs(cut._replace(work=(0.0, cut.work[1])).off) > 5.0
