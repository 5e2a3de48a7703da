"""A session goes on from its whole state at any frame with the same bits, and is reported."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_copies import rewritten
from made_session import PERIOD, make_session, watched

from cutting_trainer.bags.comparison import Comparison, compare
from cutting_trainer.bags.reader import Recorded, open_bag
from cutting_trainer.bags.recorded_frames import contact_message, read_run
from cutting_trainer.bags.resimulation import Resimulation
from cutting_trainer.bags.resimulation_start import find_beginning
from cutting_trainer.bags.topic_names import FORCE, MEMORY, POSE, STATE
from cutting_trainer.cli import main as cli
from cutting_trainer.cutting.memory import from_state as memory_of
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec, PoseStampedCodec, StampedMessage
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation
from cutting_trainer.recordings.what_if import Hand, closed_loop, recorded_run, run_experiment
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.contact.blade import Resistance
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.contact.tool import ContactState, Frame
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.motion.parallel_euler import ParallelEuler
from cutting_trainer.tissue_sim.simulation.serialisation import (
    ObjectState,
    StateError,
    capture,
    classes_of,
    rebuild,
)
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.simulation.state import from_state, smallest_mesh, state_of

pytestmark = pytest.mark.long

SAMPLE = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'straight_cut'
EVERY = 7
STATE_EVERY = 6
VISCOUS = {
    'tissue.material.prony': '[[0.3, 0.05], [0.2, 1.0]]',
    'tissue.gravity': '[0.0, 0.0, -9.81]',
}
ALIKE = 20
"""Frames for which original and restored one are compared."""


@dataclass
class Moment:
    """What a frame began with and came to."""

    contact: StampedMessage | None
    frame: Frame
    bits: bytes


def bits_of(computed: Resimulation, frame: Frame) -> bytes:
    """All that a frame came to."""
    simulation = computed.simulation
    arrays = (
        simulation.displacement,
        simulation.velocity,
        simulation.mesh.rest,
        simulation.mesh.tetrahedra,
        frame.force,
        frame.stiffness,
        np.array([frame.resistance, frame.kinetic_energy, frame.elastic_energy]),
        np.array([frame.state, frame.substeps, frame.command is not None]),
    )
    return b''.join(array.tobytes() for array in arrays)


def played(scene: Scene) -> tuple[dict[int, Moment], dict[int, tuple[ObjectState, ObjectState]]]:
    """The session of the sample's hand in a scene."""
    codec = PoseStampedCodec()
    poses = [codec.decode(m.data) for m in open_bag(SAMPLE).messages([POSE])]
    hand = Hand(ForcePath(scene.tool, scene.device, scene.haptics, scene.profile))
    computed = watched(scene, EVERY)
    untils = range(poses[0].stamp_ns + PERIOD, poses[-1].stamp_ns, PERIOD)
    times = ((until, until) for until in untils)
    moments = {}
    for frame, _ in closed_loop(poses, times, hand, computed):
        moments[frame.step] = Moment(hand.contact, frame, bits_of(computed, frame))
    return moments, computed.kept


def going_on(
    scene: Scene, tissue: ObjectState, cutting: ObjectState, moments: dict[int, Moment], step: int
) -> Iterator[tuple[int, bytes]]:
    """The frames from one on, computed from its state."""
    method = make_method(scene.cutting)
    memory = memory_of(cutting, method)
    computed = Resimulation(from_state(tissue), method)
    computed.remember(memory.method, memory.mesh)
    for later in range(step, min(step + ALIKE, max(moments) + 1)):
        computed.answer()
        said = moments[later].contact
        mesh = computed.simulation.mesh
        contact = None if said is None else tool_contact(contact_message(said), mesh)
        yield later, bits_of(computed, computed.frame(contact))


@pytest.mark.parametrize(
    'changes',
    [
        pytest.param({}, id='as-recorded', marks=pytest.mark.thorough),
        pytest.param(
            {'tissue.integrator': 'implicit', 'tissue.model': 'corotational'}, id='implicit'
        ),
        pytest.param(
            {'tissue.active_region.mode': 'on', 'tissue.model': 'linear_smoothed'},
            id='active',
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            {'tissue.active_region': '{mode: budget, nodes: 60}', 'cutting.method': 'subdivide'},
            id='budget',
        ),
        pytest.param(
            {'tissue.model': 'corotational_smoothed', 'cutting.method': 'delete'},
            id='smoothed',
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            {'tissue.model': 'stiffening', 'tissue.material.stiffening': '6'},
            id='law',
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            {'tissue.model': 'stiffening', 'tissue.active_region.mode': 'on'},
            id='law-active',
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            VISCOUS | {'tissue.model': 'linear', 'tissue.active_region.mode': 'on'},
            id='viscous-active',
        ),
        pytest.param(
            VISCOUS | {'tissue.model': 'stiffening', 'tissue.material.stiffening': '6'},
            id='viscous-law',
            marks=pytest.mark.thorough,
        ),
        pytest.param({'tissue.budget.cores': '3', 'tissue.model': 'stiffening'}, id='threads'),
        pytest.param(
            {
                'tissue.budget.cores': '2',
                'tissue.model': 'stiffening',
                'tissue.active_region': '{mode: budget, nodes: 60}',
            },
            id='threads-budget',
            marks=pytest.mark.thorough,
        ),
    ],
)
def test_frames_go_on_from_the_state_of_any_frame_with_the_same_bits(
    tmp_path: Path, changes: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ParallelEuler, 'min_nodes', 0)
    scene = load_scene(str(restore_scene(open_bag(SAMPLE), tmp_path, changes)))
    moments, kept = played(scene)
    before = {
        state: [s for s in kept if moments[s - 1].frame.state is state] for state in ContactState
    }
    inside = before[ContactState.INSIDE]
    after = [s for s in before[ContactState.NONE] if s > inside[0]] or inside[-1:]
    for step in {before[ContactState.TOUCHING][-1], inside[0], inside[len(inside) // 2], after[0]}:
        tissue, cutting = kept[step]
        for later, bits in going_on(scene, tissue, cutting, moments, step):
            assert bits == moments[later].bits, f'frame {later} from the state of frame {step}'


@pytest.fixture(scope='module')
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bag of a recorder that came when the blade was in the tissue; it has a state in there."""
    folder = tmp_path_factory.mktemp('late')
    bag = open_bag(make_session(SAMPLE, folder / 'whole', folder, every=STATE_EVERY))
    inside = [
        s.stamp_ns
        for s in (ForceSampleCodec().decode(m.data) for m in bag.messages([FORCE]))
        if s.values[ForceSampleCodec.fields['state']][0] == ContactState.INSIDE
    ]
    begin = inside[2 * len(inside) // 3] - PERIOD // 2
    return rewritten(folder / 'whole', folder / 'late', lambda m: since(m, begin))


def since(recorded: Recorded, begin: int) -> bytes | None:
    return recorded.data if recorded.log_time >= begin else None


def compared(folder: Path, temporary: Path) -> Comparison:
    bag = open_bag(folder)
    scene = load_scene(str(restore_scene(bag, temporary)))
    beginning = find_beginning(bag)
    return compare(bag, recomputation(scene, beginning), pose_check(scene), beginning=beginning)


def test_a_bag_that_begins_in_a_stroke_is_computed_again_from_the_state_in_it(
    late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = compared(late, tmp_path)
    steps = [record.step for record in read_run(open_bag(late))[0]]
    assert result.identical and result.begins % STATE_EVERY == 0
    assert 1 < steps[0] <= result.begins < steps[0] + STATE_EVERY
    assert result.frames == result.forces == steps[-1] - result.begins + 1
    assert not result.missing
    assert result.meshes == result.frames
    code = cli_status('resimulate', str(late))
    said = capsys.readouterr().out
    assert code == 0 and said.startswith('identical')
    assert f'begins at frame {result.begins}, from the state' in said
    assert cli_status('report', str(late), '-o', str(tmp_path / 'report.html')) == 0


def test_another_tissue_begins_in_the_shape_and_with_the_cuts_that_it_had(
    late: Path, tmp_path: Path
) -> None:
    bag = open_bag(late)
    changes = {'tissue.material.toughness': '12'}
    scene = load_scene(str(restore_scene(bag, tmp_path, changes)))
    beginning = find_beginning(bag)
    computed = recomputation(scene, beginning, changed=True)
    simulation = computed.simulation
    assert simulation.step == beginning.step - 1
    assert simulation.mesh.topology > 0 and np.abs(simulation.displacement).max() > 0
    assert not simulation.velocity.any()
    assert run_experiment(bag, scene, computed).peak > 0


def test_both_sides_of_the_table_begin_after_the_frame_before_the_state(
    late: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, codec = open_bag(late), PoseStampedCodec()
    first = find_beginning(whole).step

    def without_first_state(m: Recorded) -> bytes | None:
        state = m.topic in (STATE, MEMORY) and whole.read(m).step == first
        return None if state else m.data

    bag = open_bag(rewritten(late, tmp_path / 'bag', without_first_state))
    scene, beginning = load_scene(str(restore_scene(bag, tmp_path))), find_beginning(bag)
    records = read_run(bag)[0]
    before = next(r.pose for r in records if r.step == beginning.step - 1)
    assert before is not None and records[-1].pose is not None
    stamps = [codec.decode(m.data).stamp_ns for m in bag.messages([POSE])]
    assert stamps[0] <= before.stamp_ns
    within = [s for s in stamps if before.stamp_ns < s <= records[-1].pose.stamp_ns]
    monkeypatch.setattr(
        'cutting_trainer.recordings.recorded_hand._at',
        lambda bag, topic, codec, times: np.ones((len(times), 99)),
    )
    recorded, differs = recorded_run(bag, recomputation(scene, beginning))
    changed = run_experiment(bag, scene, recomputation(scene, beginning, changed=True))
    assert differs is None
    for run in (recorded, changed):
        np.testing.assert_allclose(run.times, (np.array(within) - within[0]) * 1e-9)


def cli_status(*words: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        cli.main(list(words))
    return int(stopped.value.code or 0)


def test_a_force_that_is_not_the_recorded_one_is_caught_after_the_state_too(
    late: Path, tmp_path: Path
) -> None:
    bag, codec = open_bag(late), ForceSampleCodec('tissue')
    step = find_beginning(bag).step + 5

    def change(m: Recorded) -> bytes:
        sample = codec.decode(m.data) if m.topic == FORCE else None
        if sample is None or sample.values[0] != step:
            return m.data
        values = list(sample.values)
        values[ForceSampleCodec.fields['force'].start] += 0.25
        return codec.encode(sample.stamp_ns, values)

    result = compared(rewritten(late, tmp_path / 'bag', change), tmp_path)
    assert result.difference is not None and result.difference.step == step


def test_a_bag_without_a_state_says_from_where_it_would_be_and_is_reported_nevertheless(
    late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = rewritten(late, tmp_path / 'bare', lambda m: None if m.topic == STATE else m.data)
    assert cli_status('resimulate', str(bare)) == 2
    first = read_run(open_bag(late))[0][0].step
    assert f'begins at frame {first}, and ' in capsys.readouterr().err.replace('\n', ' ')
    assert cli_status('report', str(bare), '-o', str(tmp_path / 'report.html')) == 0


def without_memory(late: Path, folder: Path, steps: set[int]) -> Path:
    bag = open_bag(late)

    def change(m: Recorded) -> bytes | None:
        return None if m.topic == MEMORY and bag.read(m).step in steps else m.data

    return rewritten(late, folder, change)


def test_a_state_without_what_cutting_remembered_then_is_passed_over(
    late: Path, tmp_path: Path
) -> None:
    first = find_beginning(open_bag(late)).step
    bare = without_memory(late, tmp_path / 'bare', {first})
    beginning = find_beginning(open_bag(bare))
    assert beginning.step == first + STATE_EVERY and beginning.cutting is not None
    assert compared(bare, tmp_path).identical


def test_without_what_cutting_remembered_the_bag_lacks_it_and_nothing_differs(
    late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = rewritten(late, tmp_path / 'bare', lambda m: None if m.topic == MEMORY else m.data)
    first = find_beginning(open_bag(late)).step
    result = compared(bare, tmp_path)
    assert result.begins == first and result.difference is not None and result.difference.lacks
    assert cli_status('resimulate', str(bare)) == 1
    said = capsys.readouterr().out
    assert 'the bag lacks the state of the cutting service' in said and 'differs' not in said


@pytest.mark.parametrize(
    'array',
    [
        lambda s, m: s.mesh.links.tetrahedra,
        lambda s, m: s.mesh.links.neighbors,
        lambda s, m: s.mesh.links.corner_next,
        lambda s, m: s.mesh.links.first_corner,
        lambda s, m: s.mesh.links.triangles,
        lambda s, m: s.mesh.links.counts,
        lambda s, m: s.dynamics.model.tensor_mass.tensors.columns,
        lambda s, m: s.dynamics.model.tensor_mass.tensors.used,
        lambda s, m: s.dynamics.model._neighbours._rows.columns,
        lambda s, m: s.blade._state.corners,
        lambda s, m: m.mesh.links.tetrahedra,
        lambda s, m: m.method._tables.edge_nodes,
        lambda s, m: m.method._tables.children,
        lambda s, m: m.method._tables.counts,
        lambda s, m: m.method._active,
    ],
)
def test_a_state_whose_numbers_lead_out_of_its_arrays_is_refused_in_one_sentence(
    late: Path, tmp_path: Path, array: Callable[[Any, Any], np.ndarray]
) -> None:
    beginning = find_beginning(open_bag(late))
    method = make_method(load_scene(str(restore_scene(open_bag(late), tmp_path))).cutting)
    assert beginning.tissue is not None and beginning.cutting is not None
    simulation, memory = from_state(beginning.tissue), memory_of(beginning.cutting, method)
    array(simulation, memory).reshape(-1)[0] = 1 << 30
    states = state_of(simulation), memory.state()
    with pytest.raises(StateError, match='the recorded state cannot be used: '):
        from_state(states[0]), memory_of(states[1], method)


@pytest.mark.parametrize('part', ['masses', '_elastic', '_active'])
def test_a_state_whose_parts_are_of_different_models_is_refused(part: str) -> None:
    material, resistance = Material(1e4, 0.4, 1e3, 1.0, 1e-3), Resistance(1.0, 1.0, 1.0)
    one, other = (TissueSimulation(smallest_mesh(), material, resistance) for _ in range(2))
    setattr(one.dynamics, part, getattr(other.dynamics, part))
    with pytest.raises(StateError, match='its parts are of different models'):
        from_state(state_of(one))


@dataclass
class Thing:
    held: Any
    beside: Any = None


THINGS = classes_of([sys.modules[__name__]])


def test_arrays_that_share_memory_share_it_again() -> None:
    whole = np.arange(12.0).reshape(3, 4)
    again = rebuild(capture(Thing(whole, whole[1:, ::2]), THINGS), THINGS, Thing(0))
    np.testing.assert_array_equal(again.beside, [[4.0, 6.0], [8.0, 10.0]])
    again.held[1, 0] = -1.0
    assert again.beside[0, 0] == -1.0
    loop = Thing([1, (2, None), {3: np.float64(0.1)}, float('inf')])
    loop.beside = loop
    again = rebuild(capture(loop, THINGS), THINGS, Thing(0))
    assert again.beside is again and again.held == loop.held


@pytest.mark.parametrize(
    ('tree', 'data'),
    [
        ('', b''),
        ('{"root": 1, "objects": [], "arrays": []}', b''),
        ('{"root": {"object": 0}, "objects": [["os.system", {}]], "arrays": []}', b''),
        ('{"root": {"object": 7}, "objects": [], "arrays": []}', b''),
        ('{"root": {"named": ["test_mid_session.Thing", [1]]}, "objects": [], "arrays": []}', b''),
        (
            '{"root": {"array": [0, [900], [8], 0, true]}, "objects": [],'
            ' "arrays": [["<f8", [2], "C", 0, 16]]}',
            bytes(16),
        ),
        (
            '{"root": {"array": [0, [1099511627776], [0], 0, true]}, "objects": [],'
            ' "arrays": [["<f8", [1], "C", 0, 8]]}',
            bytes(8),
        ),
        (
            '{"root": {"array": [0, [9, 8], [8, 8], 0, true]}, "objects": [],'
            ' "arrays": [["<f8", [16], "C", 0, 128]]}',
            bytes(128),
        ),
        ('{"root": 0, "objects": [], "arrays": [["<f8", [1099511627776, 0], "C", 0, 0]]}', b''),
        ('{"root": 0, "objects": [], "arrays": [["<f8", [99999999999], "C", 0, 8]]}', bytes(8)),
        ('{"root": 0, "objects": [], "arrays": [["O", [1], "C", 0, 8]]}', bytes(8)),
        ('{"root": ' + '{"list": [' * 99 + ']}' * 99 + ', "objects": [], "arrays": []}', b''),
        ('[' * 100_000, b''),
        ('{"root": {"object": 0}, "objects": [["test_mid_session.Thing", {"x": 1}]], "arrays": []}',
         b''),
    ],
)  # fmt: skip
def test_a_state_that_is_none_is_refused_in_one_sentence(tree: str, data: bytes) -> None:
    with pytest.raises(StateError):
        rebuild(ObjectState(tree, data), THINGS, Thing(0))


def test_a_class_that_is_not_named_beforehand_is_not_written() -> None:
    with pytest.raises(StateError, match='none of the classes'):
        capture(Thing(Path('x')), THINGS)
