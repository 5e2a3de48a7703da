"""What diverges is caught: shorter steps if they help, else no force, and a reason in words."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from meshes import box, irregular_box
from pairs import every_explicit_pair, every_pair
from test_blade import contact_at

from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.tissue_sim.contact.blade import Resistance, Sweep
from cutting_trainer.tissue_sim.contact.coupling import HOLD, PUSH, Coupling, Tool
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.divergence import DivergenceDetector
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

RESISTANCE = Resistance(100.0, 40.0, 0.0)


def simulation(
    name: ModelName = 'linear',
    integrator: IntegratorName = 'rk4',
    *,
    nu: float = 0.4,
    safety: float = 0.8,
    mesh: TetMesh | None = None,
) -> TissueSimulation:
    if mesh is None:
        nodes, tets = box((8, 4, 4), 0.005)
        mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    stepping = TimeStepping(
        integrator, safety=safety, min_substeps=4 if integrator == 'implicit' else 1,
        max_substeps=5000,
    )  # fmt: skip
    material = Material(5000.0, nu, 1000.0, 5.0, 2e-4)
    return TissueSimulation(mesh, material, RESISTANCE, model=name, stepping=stepping)


def press(tissue: TissueSimulation, frames: int, depth: float = 0.003) -> list[str]:
    """Presses the tool in over eight frames and holds it; what went wrong, in words."""
    troubles = []
    for k in range(frames):
        tip = np.array([0.02, 0.01, 0.0205 - depth * min(k / 8, 1.0)])
        frame = tissue.frame(contact_at(tissue, tip))
        assert np.isfinite(frame.force).all()
        assert np.linalg.norm(frame.force) < 2.0
        troubles += [frame.trouble] if frame.trouble else []
    return troubles


@pytest.mark.long
@every_pair
def test_the_default_share_of_the_step_gives_no_trouble(
    name: ModelName, integrator: IntegratorName
) -> None:
    assert press(simulation(name, integrator), 10) == []


@every_explicit_pair
def test_a_step_above_the_limit_is_caught_named_and_mended(
    name: ModelName, integrator: IntegratorName
) -> None:
    tissue = simulation(name, integrator, safety=2.5)
    troubles = press(tissue, 12)
    assert troubles
    assert 'a step of' in troubles[0] and integrator in troubles[0] and 'rad/s' in troubles[0]
    reference = simulation(name, integrator)
    press(reference, 12)
    np.testing.assert_allclose(
        tissue.displacement, reference.displacement,
        atol=0.25 * np.abs(reference.displacement).max(),
    )  # fmt: skip


@every_pair
def test_what_shorter_steps_do_not_mend_is_taken_back_with_no_force(
    name: ModelName, integrator: IntegratorName
) -> None:
    tissue = simulation(name, integrator)
    press(tissue, 9)
    before = tissue.displacement.copy()
    tissue.velocity[:] = 1e5
    frame = tissue.frame(contact_at(tissue, np.array([0.02, 0.01, 0.0175])))
    assert frame.diverged
    assert 'farther than the tissue is long' in frame.trouble
    assert 'tetrahedra are inside out' in frame.trouble
    assert f'{integrator} is stable' in frame.trouble
    assert not frame.force.any()
    assert np.array_equal(tissue.displacement, before)
    assert press(tissue, 3) == []


@pytest.mark.parametrize('speed', [1e3, 1e200, 1e308])
def test_a_blade_in_a_tissue_that_diverges_within_a_frame_is_not_asked_where_it_is(
    speed: float,
) -> None:
    tissue = simulation()
    asked: list[bool] = []

    class WatchingTool:
        """A tool without force, in 8 parts of a frame."""

        parts = 8

        def restart(self) -> Coupling:
            return Coupling()

        def after(self, _share: float, positions: np.ndarray) -> Coupling:
            asked.append(bool(np.abs(positions).max() < 0.2))
            return Coupling()

    tissue.dynamics.velocity[:] = speed
    with np.errstate(all='ignore'):
        assert tissue.dynamics.advance(Coupling(), tools=[WatchingTool()]).diverged
    assert all(asked)


def test_frames_that_need_shorter_steps_one_after_another_do_not_get_longer_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tissue = simulation()
    usual = tissue.frame(None).substeps
    verdicts = itertools.cycle(['it diverges', ''])  # and the next attempt does not
    monkeypatch.setattr(DivergenceDetector, 'diagnose', lambda *_: next(verdicts))
    frames = [tissue.frame(None) for _ in range(6)]
    assert frames[0].substeps == 4 * usual and not frames[0].diverged
    assert max(frame.substeps for frame in frames) <= 16 * usual
    assert any(frame.diverged for frame in frames)


@pytest.mark.parametrize(
    ('name', 'integrator', 'most'),
    [('linear', 'rk4', 5), ('linear', 'implicit', 21), ('corotational', 'rk4', 21)],
)
def test_a_frame_that_is_taken_back_costs_so_many_frames_at_most(
    name: ModelName, integrator: IntegratorName, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps far below what is stable whatever the shape would mend nothing, and delay the rest."""
    tissue = simulation(name, integrator)
    usual, spent = tissue.frame(None).substeps, []
    integrate = Dynamics._integrate

    def counted(
        dynamics: Dynamics, coupling: Coupling, dt: float, substeps: int, tool: Tool | None
    ) -> float:
        spent.append(substeps)
        return integrate(dynamics, coupling, dt, substeps, tool)

    monkeypatch.setattr(Dynamics, '_integrate', counted)
    monkeypatch.setattr(DivergenceDetector, 'diagnose', lambda *_: 'it diverges')
    assert tissue.frame(None).diverged
    assert sum(spent) == most * usual


def test_forward_euler_without_damping_is_refused_in_words() -> None:
    nodes, tets = box((2, 2, 2), 0.01)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    with pytest.raises(ValueError, match='no stable step with damping alpha 0'):
        Dynamics(mesh, Material(5000.0, 0.4, 1000.0), 'linear', TimeStepping('euler'))


def cut_block(name: ModelName, integrator: IntegratorName, method: str) -> TissueSimulation:
    nodes, tets = irregular_box((5, 3, 3), 0.005, 3, jitter=0.15)
    mesh = TetMesh(nodes, tets, nodes[:, 2] < 1e-9)
    tissue = simulation(name, integrator, mesh=mesh)
    cutter = make_method(CuttingSettings.model_validate({'method': method}))
    way = np.linspace(-0.002, 0.017, 7)
    path = np.array([[[0.0137, y, 0.03], [0.0137, y, 0.0063]] for y in way])
    for k in range(6):
        result = cutter.advance(mesh, tissue.positions, Sweep(*path[k], *path[k + 1]))
        if not result.delta.empty:
            tissue.apply_cut(result.delta)
        frame = tissue.frame(None)
        assert not frame.trouble
    tissue.apply_cut(cutter.finish(mesh, tissue.positions).delta)
    return tissue


@pytest.mark.long
@every_pair
def test_after_a_cut_through_elements_the_bound_holds_and_the_lips_come_to_rest(
    name: ModelName, integrator: IntegratorName
) -> None:
    """Cut at the true crossings: the method that makes slivers."""
    tissue = cut_block(name, integrator, 'subdivide')
    dynamics = tissue.dynamics
    root = np.sqrt(dynamics.masses.inverse)
    true = np.sqrt(np.linalg.eigvalsh(root[:, None] * dynamics.model.dense() * root)[-1])
    assert true < dynamics.masses.omega
    rng = np.random.default_rng(0)
    free = tissue.mesh.fixed == 0
    tissue.displacement[free] += 2e-5 * rng.normal(size=(int(free.sum()), 3))
    dynamics.restart()
    first = tissue.frame(None)
    frames = [tissue.frame(None) for _ in range(12)]
    assert not any(frame.trouble for frame in frames)
    energies = [frame.kinetic_energy + frame.elastic_energy for frame in (first, *frames)]
    assert energies[-1] < 0.5 * energies[0]


@every_pair
def test_an_inverted_element_does_not_blow_up(name: ModelName, integrator) -> None:
    tissue = simulation(name, integrator)
    mesh = tissue.mesh
    node = int(np.argmin(np.linalg.norm(mesh.rest - [0.02, 0.01, 0.02], axis=1)))
    tissue.displacement[node] = [0.0, 0.0, -0.009]
    tissue.dynamics.restart()
    assert tissue.dynamics.inverted > 0
    frames = [tissue.frame(None) for _ in range(30)]
    assert not any(frame.diverged for frame in frames)
    assert tissue.dynamics.inverted == 0
    assert np.abs(tissue.displacement).max() < 1e-3


@pytest.mark.long
@every_pair
def test_a_tool_that_jumps_through_the_tissue_is_not_believed(
    name: ModelName, integrator: IntegratorName
) -> None:
    tissue = simulation(name, integrator)
    press(tissue, 9)
    there = contact_at(tissue, np.array([0.02, 0.01, 0.0175]))
    jumped = replace(there, device=there.device - np.array([0.0, 0.0, 0.3]))
    frame = tissue.frame(jumped)
    assert not frame.force.any()
    assert 'the tool has moved by 300 mm within a frame' in frame.trouble
    # It stays there, pressing with 60 N: whatever comes of that is finite, or taken back.
    for _ in range(5):
        frame = tissue.frame(jumped)
        assert np.isfinite(frame.force).all()
        assert np.isfinite(tissue.displacement).all()
        assert not frame.diverged or (frame.trouble and not frame.force.any())


@every_pair
def test_near_incompressibility_only_shortens_the_step(
    name: ModelName, integrator: IntegratorName
) -> None:
    assert press(simulation(name, integrator, nu=0.499), 4) == []


def test_energy_from_nowhere_is_found_before_it_is_large() -> None:
    nodes, tets = box((4, 4, 2), 0.01)
    guard = DivergenceDetector(TetMesh(nodes, tets), 5000.0)
    u = np.zeros_like(nodes)
    assert guard.diagnose(u, 1e-4, 1e-4) == ''
    assert guard.diagnose(u, 0.9e-4, -0.1e-4) == ''
    assert 'the tool has put in' in guard.diagnose(u, 5e-4, 0.1e-4)
    assert guard.diagnose(u, 1.2e-4, 0.5e-4) == ''
    u[0] = np.nan
    assert 'farther' in guard.diagnose(u, np.nan, 0.0)


@pytest.mark.long
@pytest.mark.parametrize('active', [ActiveSettings(), ActiveSettings('on')], ids=['all', 'region'])
def test_a_loose_piece_that_is_pushed_away_stops_and_the_rest_goes_on(
    active: ActiveSettings,
) -> None:
    rest, tets = box((4, 4, 2), 0.01)
    piece, others = box((1, 1, 1), 0.01)
    nodes = np.concatenate([rest, piece + np.array([0.0, 0.0, 0.03])])
    mesh = TetMesh(nodes, np.concatenate([tets, others + len(rest)]), nodes[:, 2] < 1e-9)
    dynamics = Dynamics(mesh, Material(5000.0, 0.4, 1000.0, 5.0, 1e-5), active=active)
    size, free = float(np.linalg.norm(np.ptp(nodes, axis=0))), np.arange(len(rest), len(nodes))
    dynamics.velocity[free, 0] = 2.0
    dynamics.velocity[free, 2] = np.random.default_rng(0).normal(0.0, 0.5, len(free))
    dynamics.restart()
    corner = np.array([np.argmax(rest.sum(axis=1))])
    troubles, depth, count = [], 0.0, 0
    for k in range(40):
        before, here = (rest[corner[0]] - [0, 0, 1e-4 * j] for j in (k, k + 1))
        motion = dynamics.advance(Coupling(PUSH, corner, np.ones(1), before, here, stiffness=200.0))
        assert not motion.diverged
        troubles.append(motion.trouble)
        energy = dynamics.model.evaluate(dynamics.displacement)[1]
        assert motion.elastic_energy == pytest.approx(energy, rel=1e-6)
        count += motion.substeps
        assert dynamics.displacement[corner[0], 2] < depth
        depth = dynamics.displacement[corner[0], 2]
    said = [trouble for trouble in troubles if trouble]
    assert len(said) == 1 and 'a piece that nothing held' in said[0]
    assert 0.5 * size < dynamics.displacement[free].max() < size
    assert not dynamics.velocity[free].any()
    assert not np.ptp(dynamics.displacement[free], axis=0).any()  # it has its shape at rest
    assert count == 40 * motion.substeps


class _Entering:
    """A tool that from the second quarter of a frame on holds one light node."""

    parts = 4

    def __init__(self, node: int, place: np.ndarray, stiffness: float) -> None:
        self._held = Coupling(HOLD, np.array([node]), np.ones(1), place, place, stiffness=stiffness)

    def restart(self) -> Coupling:
        return Coupling()

    def after(self, share: float, positions: np.ndarray) -> Coupling:
        return self._held


def test_the_step_follows_a_spring_that_is_new_within_a_frame() -> None:
    tissue = simulation(integrator='symplectic_euler').dynamics
    node = int(np.flatnonzero(tissue.mesh.fixed == 0)[0])
    stiffness = 3.0 * tissue.masses.omega**2 * float(tissue.model.mass[node])
    place = tissue.mesh.rest[node] + [0.0, 0.0, 1e-5]
    calm = tissue.advance(Coupling())
    motion = tissue.advance(Coupling(), tools=[_Entering(node, place, stiffness)])
    assert motion.trouble == ''
    assert calm.substeps < motion.substeps <= 4 * calm.substeps
    assert motion.slow_motion == pytest.approx(1.0)
