"""Several threads move a tissue as one does, and their number does not change a bit."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import irregular_box

from cutting_trainer.haptic_bridge.emulated_arm.hand import EmulatedHand, compile_script
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.session.in_process import simulate
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.session.scene_overrides import write_changed
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.coupling import HOLD, PUSH, Coupling
from cutting_trainer.tissue_sim.contact.tool import indenter_contact
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import MODELS, ElasticModel, ModelName
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings
from cutting_trainer.tissue_sim.motion.division import Shared, division_of, shared_out
from cutting_trainer.tissue_sim.motion.dynamics import Dynamics
from cutting_trainer.tissue_sim.motion.integrators import IntegratorName
from cutting_trainer.tissue_sim.motion.parallel_euler import PARALLEL, ParallelEuler
from cutting_trainer.tissue_sim.motion.time_steps import TimeStepping
from cutting_trainer.tissue_sim.simulation.serialisation import StateError
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state import from_state, state_of

FRAMES = 12
ROUNDING = 1e-9
"""Of the largest displacement: sums of forces in another order, over some hundred substeps."""


@pytest.fixture(autouse=True)
def _small_meshes_are_shared() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ParallelEuler, 'min_nodes', 0)
        patch.setattr('cutting_trainer.tissue_sim.motion.division._NODES_OF_PART', 8)
        yield


def block(prony: tuple[tuple[float, float], ...] = ()) -> tuple[TetMesh, Material]:
    nodes, tets = irregular_box((5, 4, 3), 0.01, 7, 0.15)
    material = Material(5000.0, 0.45, 1000.0, 5.0, 2e-4, 6.0, prony)
    return TetMesh(nodes, tets, nodes[:, 2] < 1e-9), material


def moved(
    threads: int,
    model: ModelName,
    integrator: IntegratorName = 'symplectic_euler',
    active: ActiveSettings | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    prony: tuple[tuple[float, float], ...] = (),
) -> np.ndarray:
    """Displacement and velocity of a block that is pushed in and pulled along [m], [m/s]."""
    mesh, material = block(prony)
    stepping = TimeStepping(integrator, safety=0.5)
    tissue = Dynamics(mesh, material, model, stepping, active, gravity, threads=threads)
    top = np.flatnonzero(mesh.rest[:, 2] > mesh.rest[:, 2].max() - 1e-4)[:6]
    share, middle = np.full(len(top), 1 / len(top)), mesh.rest[top].mean(axis=0)
    for number in range(FRAMES):
        goal = middle + 0.004 * number / FRAMES * np.array([1.0, 0.0, -1.0])
        mode = PUSH if number < FRAMES // 2 else HOLD
        tissue.advance(Coupling(mode, top, share, goal, goal, stiffness=400.0))
    return np.array([tissue.displacement, tissue.velocity])


def assert_alike(some: np.ndarray, other: np.ndarray, share: float = ROUNDING) -> None:
    for one, two in zip(some, other, strict=True):
        assert np.abs(one).max() > 1e-5
        assert np.abs(one - two).max() <= share * np.abs(one).max()


@pytest.mark.parametrize('model', MODELS)
@pytest.mark.parametrize('integrator', PARALLEL)
def test_threads_move_a_tissue_as_one_does(model: ModelName, integrator: IntegratorName) -> None:
    alone = moved(1, model, integrator)
    for threads in (2, 3, 7):
        assert_alike(moved(threads, model, integrator), alone)


@pytest.mark.parametrize('model', ['linear', 'linear_smoothed', 'stiffening'])
@pytest.mark.parametrize(
    'active', [ActiveSettings('budget', 40), ActiveSettings('on')], ids=['far-field', 'sleepers']
)
def test_threads_share_a_part_of_the_tissue(model: ModelName, active: ActiveSettings) -> None:
    # Where nodes sleep, strained elements are searched for at other substeps.
    share = 1e-3 if (model, active.mode) == ('stiffening', 'on') else ROUNDING
    assert_alike(moved(3, model, active=active), moved(1, model, active=active), share)


@pytest.mark.parametrize('model', ['linear', 'stiffening'])
def test_weight_and_viscosity_count_once(model: ModelName) -> None:
    loads = {'gravity': (0.0, 0.0, -9.81), 'prony': ((0.4, 0.1),)}
    assert_alike(moved(4, model, **loads), moved(1, model, **loads))  # type: ignore[arg-type]


def place_threads(processors: set[int]) -> None:
    """Put all threads of this process on some processors."""
    for thread in Path('/proc/self/task').iterdir():
        with suppress(ProcessLookupError):  # it has just ended
            os.sched_setaffinity(int(thread.name), processors)


def test_bits_depend_neither_on_the_number_of_threads_nor_on_the_processors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, all_of_them = MODELS[-1], os.sched_getaffinity(0)
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: range(16))
    first = moved(2, model)
    for threads in (2, 3, 16):
        np.testing.assert_array_equal(moved(threads, model), first)
    try:
        place_threads({min(all_of_them)})
        np.testing.assert_array_equal(moved(3, model), first)
        monkeypatch.undo()  # one thread does all of it
        np.testing.assert_array_equal(moved(3, model), first)
    finally:
        place_threads(all_of_them)


def listed(shared: Shared) -> list[int]:
    return [i for low, high in shared.values for i in range(low, high)]


def test_each_row_domain_element_and_node_belongs_to_one_part() -> None:
    mesh, material = block()
    operands = ElasticModel(mesh, material, 'stiffening').operands()
    n = mesh.node_count
    found = division_of(operands, operands.awake, n)
    for shared in (found.rows, found.domains, found.moved):
        assert listed(shared) == list(range(n))
    for shared in (found.rows, found.domains, found.moved, found.chunks):
        assert shared.begins[0] == 0 and shared.begins[-1] == len(shared.values)
        assert (np.diff(shared.begins) >= 0).all()
    np.testing.assert_array_equal(np.sort(found.chunks.values), operands.chunks)


@given(
    st.lists(st.tuples(st.integers(1, 5), st.integers(1, 90)), max_size=6),
    st.integers(1, 16),
    st.integers(0, 2**16),
)
def test_intervals_are_shared_out_whole_and_evenly(
    gaps_and_lengths: list[tuple[int, int]], parts: int, seed: int
) -> None:
    ends = np.cumsum(np.array(gaps_and_lengths, np.int64).reshape(-1)).reshape(-1, 2)
    size = int(ends[-1, 1]) if len(ends) else 0
    cost = np.random.default_rng(seed).integers(0, 20, size)
    found = Shared(*shared_out(ends, cost, parts))
    inside = listed(Shared(ends, np.zeros(0)))
    assert listed(found) == inside
    whole = sum(1 + int(cost[i]) for i in inside)
    for part in range(parts):
        own = listed(Shared(found.values[found.begins[part] : found.begins[part + 1]], ends))
        assert sum(1 + int(cost[i]) for i in own) <= whole / parts + 20


def cut_block(folder: Path, cores: str) -> tuple[int, np.ndarray]:
    """Elements that the scene's script cuts, and the place of its surface at the end [m]."""
    folder.mkdir()
    changed = write_changed(load_scene('block'), folder, {'tissue.budget.cores': cores})
    scene, session, seconds = load_scene(str(changed)), simulate(str(changed)), 6.0
    place = scene.device.tissue_from_device
    script = compile_script(scene.arm.require_script(), place, seconds)
    hand = EmulatedHand(scene.arm.hand, script)
    for tick in range(int(1000 * seconds)):
        hand.move_to(1e-3 * tick, 1e-3 * tick)
        session.tick(hand.position, tuple(hand.orientation))
    simulation = session.tissue.simulation
    return simulation.elements_cut, simulation.positions


def test_a_tissue_is_cut_as_by_one_thread(tmp_path: Path) -> None:
    (count, alone), (also, shared) = (cut_block(tmp_path / cores, cores) for cores in ('1', '3'))
    assert count == also > 10
    np.testing.assert_allclose(shared, alone, atol=1e-6)


def recorded(model: ModelName = 'linear', mode: Literal['off', 'on'] = 'off') -> TissueSimulation:
    """A simulation by three threads, after a frame."""
    mesh, material = block()
    euler, none = TimeStepping('symplectic_euler'), Resistance(1.0, 1.0, 1.0)
    active = ActiveSettings(mode)
    made = TissueSimulation(
        mesh, material, none, model=model, stepping=euler, active=active, threads=3
    )
    made.frame(indenter_contact(mesh, mesh.rest.max(axis=0), np.array([0.0, 0.0, -1.0]), 1e-3))
    return made


@pytest.mark.parametrize(
    ('name', 'value'),
    [('_threads', 1), ('_threads', 17), ('_threads', 10**9), ('_threads', 2.0), ('_threads', [2]),
     ('min_nodes', 0)],
)  # fmt: skip
def test_a_recorded_state_starts_no_threads_that_a_scene_would_not(name: str, value: Any) -> None:
    simulation = recorded()
    integrator = from_state(state_of(simulation)).dynamics._integrator
    assert isinstance(integrator, ParallelEuler) and integrator._threads == 3
    setattr(simulation.dynamics._integrator, name, value)
    with pytest.raises(StateError, match=name):
        from_state(state_of(simulation))


@pytest.mark.parametrize('spans', [[[-1_000_000, 0]], [[0, 1_000_000]], [0, 1]])
def test_a_recorded_state_has_no_intervals_beyond_the_tissue(spans: list[Any]) -> None:
    simulation = recorded('corotational', 'on')
    region = simulation.dynamics._active._region  # type: ignore[union-attr]
    assert region is not None
    operands = region.operands._replace(spans=np.array(spans))
    simulation.dynamics._active._region = region._replace(operands=operands)  # type: ignore[union-attr]
    with pytest.raises(StateError, match='spans'):
        from_state(state_of(simulation))


def test_a_session_whose_steps_threads_cannot_share_is_computed_by_one(tmp_path: Path) -> None:
    changes = {'tissue.budget.cores': '2', 'tissue.integrator': 'rk4'}
    scene = load_scene(str(write_changed(load_scene('block'), tmp_path, changes)))
    simulation, _ = make_simulation(scene.tissue)
    assert not simulation.dynamics.parallel
    assert simulation.frame(None).substeps


@pytest.mark.parametrize('cores', ['1.5', '0', '17', 'many'])
def test_cores_are_a_share_of_one_or_a_whole_number(tmp_path: Path, cores: str) -> None:
    with pytest.raises(SceneError, match='cores'):
        load_scene(
            str(write_changed(load_scene('block'), tmp_path, {'tissue.budget.cores': cores}))
        )
