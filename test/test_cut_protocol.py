"""One protocol of cuts: the node, a session computed again and one in a process give the same bits,
however late the answers of `cutting` are.
"""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from cutting_trainer_msgs.msg import ForceSample, FrameInputs
from cutting_trainer_msgs.srv import Cut
from live import free_domain

from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_frames import FrameRecord, read_run
from cutting_trainer.bags.resimulation import Resimulation
from cutting_trainer.cutting.combined import CombinedMethod
from cutting_trainer.cutting.method_interface import FAILURES, SweepError, carry_out
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.node_common.lifecycle import Stop
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation
from cutting_trainer.session.in_process import Tissue
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim import node as node_module
from cutting_trainer.tissue_sim.contact.blade import Sweep
from cutting_trainer.tissue_sim.contact.incoming import tool_contact
from cutting_trainer.tissue_sim.contact.tool import CutCommand, CutOutcome, ToolContact
from cutting_trainer.tissue_sim.mesh.replica import state_hash
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation
from cutting_trainer.tissue_sim.streaming import cut_client
from cutting_trainer.tissue_sim.streaming.messages import delta_into

pytestmark = pytest.mark.long

CUT = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2' / 'straight_cut'
PERIOD = 1 / 30


class Clock:
    """Time that passes only where somebody sleeps; in the place of the module `time`."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return int(self.now * 1e9)

    time_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Loop:
    """Frames at their times, a number of them."""

    def __init__(self, clock: Clock, frames: int, stop: Stop) -> None:
        self._clock, self._left, self._stop = clock, frames, stop

    def start(self) -> None:
        self._next = self._clock.now

    def wait(self) -> int:
        if self._left == 0:
            self._stop.set()
        self._left -= 1
        self._next = max(self._next + PERIOD, self._clock.now)
        self._clock.now = self._next
        return 0

    def report(self) -> dict[str, float]:
        return {}


class Cutting:
    """The service, which computes at once and answers late.

    Args:
        delays: of the answers in their order [s]; infinite: never.
    """

    def __init__(
        self, clock: Clock, simulation: TissueSimulation, scene: Scene, delays: Iterator[float]
    ) -> None:
        self._clock, self._simulation, self._delays = clock, simulation, delays
        self._method = make_method(scene.cutting)
        self.commands: list[int] = []
        self._begin_anew()

    def _begin_anew(self) -> None:
        mesh = self._simulation.mesh
        self._method.abort()
        self._mesh = TetMesh(mesh.rest, mesh.tetrahedra, mesh.fixed)
        self._mesh.topology = mesh.topology
        self._mesh.set_kinds(mesh.triangles, mesh.triangle_kind)

    def service_is_ready(self) -> bool:
        return True

    def remove_pending_request(self, future: Any) -> None:
        pass

    def call_async(self, request: Cut.Request) -> Any:
        self.commands.append(request.command)
        response = self._answer(request)
        due = self._clock.now + next(self._delays)
        return SimpleNamespace(done=lambda: self._clock.now >= due, result=lambda: response)

    def _answer(self, request: Cut.Request) -> Cut.Response:
        response = Cut.Response(success=True, topology=self._mesh.topology)
        if request.command == Cut.Request.ABORT:
            self._begin_anew()
            return response
        positions = self._mesh.rest + self._simulation.displacement
        sweep = Sweep(request.root_from, request.tip_from, request.root_to, request.tip_to)
        command = CutCommand(request.command)
        try:
            result = carry_out(self._method, self._mesh, positions, command, sweep)
        except SweepError as error:
            code = Cut.Response.INVALID_SWEEP
            return Cut.Response(success=False, error_code=code, error_msg=str(error))
        delta_into(response, result.delta)
        if not result.delta.empty:
            self._mesh.apply(result.delta)
        return response


class Session:
    """What a way of computing came to: forces by frame [N], shape (n, 3), tetrahedra, mesh hash."""

    def __init__(self, forces: list[np.ndarray], simulation: TissueSimulation) -> None:
        mesh = simulation.mesh
        self.forces = np.array(forces)
        self.cut = simulation.elements_cut
        self.hash = state_hash(mesh.rest, simulation.displacement, mesh.tetrahedra)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Session) and (
            np.array_equal(self.forces, other.forces) and self.hash == other.hash
        )


class Lived(Session):
    """A session of the node, with the inputs of its frames, commands and diagnostics."""

    inputs: list[FrameInputs]
    commands: list[int]
    values: dict[str, object]

    @property
    def outcomes(self) -> list[int]:
        return [inputs.answer for inputs in self.inputs]


@pytest.fixture(scope='module')
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(str(restore_scene(open_bag(CUT), tmp_path_factory.mktemp('scene'))))


@pytest.fixture(scope='module')
def records(scene: Scene) -> list[FrameRecord]:
    """Frames in, through and out of the tissue, from the first contact on.

    The bag was recorded with an earlier law of the blade: it cut elsewhere, and nodes that came
    with its cuts may not be there.
    """
    every = read_run(open_bag(CUT))[0]
    first = next(i for i, record in enumerate(every) if record.has_contact)
    last = recomputation(scene).simulation.mesh.node_count - 1
    for record in every[first:]:
        if record.contact:
            record.contact.nodes = np.minimum(record.contact.nodes, last)
    return every[first:]


@pytest.fixture
def node(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Iterator[node_module.TissueSimNode]:
    arguments = ['--ros-args', '-p', f'scene:={scene.path}']
    rclpy.init(args=arguments, domain_id=free_domain())
    node = node_module.TissueSimNode()
    node.trigger_configure()
    assert node.problem is None
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown()


def lived(
    node: node_module.TissueSimNode,
    scene: Scene,
    records: list[FrameRecord],
    delays: Iterator[float],
    monkeypatch: pytest.MonkeyPatch,
) -> Lived:
    """The node's own loop under recorded contacts, in a time of its own."""
    clock, stop, simulation = Clock(), Stop(), node._simulation
    node._announced = -np.inf  # no recorder is waited for
    monkeypatch.setattr(node_module, 'time', clock)
    monkeypatch.setattr(cut_client, 'time', clock)
    cutting = Cutting(clock, simulation, scene, delays)
    node._loop = Loop(clock, len(records), stop)
    node._cuts._client = cutting
    (tool,) = node._tools
    contact = lambda mesh: contact_of(records[simulation.step], simulation)  # noqa: E731
    monkeypatch.setattr(tool, 'contact', contact)
    forces: list[ForceSample] = []
    inputs: list[FrameInputs] = []
    monkeypatch.setattr(tool._forces, 'publish', forces.append)
    monkeypatch.setattr(tool._inputs, 'publish', inputs.append)
    node.work(stop)
    session = Lived([sample.force for sample in forces], simulation)
    session.inputs, session.commands = inputs, cutting.commands
    session.values = node._status_now()[2] | node.rejections.values()
    return session


def contact_of(record: FrameRecord, simulation: TissueSimulation) -> ToolContact | None:
    return record.contact and tool_contact(record.contact, simulation.mesh)


def computed_again(computed: Resimulation, records: list[FrameRecord]) -> Session:
    forces = []
    for record in records:
        computed.answer()
        forces.append(computed.frame(contact_of(record, computed.simulation)).force)
    return Session(forces, computed.simulation)


def in_process(scene: Scene, records: list[FrameRecord]) -> Session:
    simulation = recomputation(scene).simulation
    tissue = Tissue(simulation, make_method(scene.cutting))
    forces = [tissue.frame(contact_of(record, simulation)).force for record in records]
    return Session(forces, simulation)


@pytest.fixture(scope='module')
def prompt(scene: Scene, records: list[FrameRecord]) -> Session:
    """The session without any clock."""
    return computed_again(recomputation(scene), records)


def random_delays() -> Iterator[float]:
    random = np.random.default_rng(1)
    while True:
        yield float(random.choice([0.001, 0.02, 0.04, 0.1, 0.4]) * random.uniform(0.5, 1.5))


@pytest.mark.parametrize(
    ('delays', 'waits'),
    [
        (lambda: itertools.repeat(0.0), False),
        pytest.param(lambda: itertools.repeat(0.005), False, marks=pytest.mark.thorough),
        pytest.param(lambda: itertools.repeat(0.05), True, marks=pytest.mark.thorough),
        pytest.param(lambda: itertools.repeat(0.2), True, marks=pytest.mark.thorough),
        (random_delays, True),
    ],
    ids=['0 ms', '5 ms', '50 ms', '200 ms', 'random'],
)
def test_the_same_contacts_give_the_same_bits_however_late_cuts_are_answered(
    node: node_module.TissueSimNode,
    scene: Scene,
    records: list[FrameRecord],
    prompt: Session,
    delays: Callable[[], Iterator[float]],
    waits: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = lived(node, scene, records, delays(), monkeypatch)
    assert session.cut == prompt.cut > 100
    assert session == prompt
    assert session.commands.count(Cut.Request.FINISH) == 1
    answered = [inputs for inputs in session.inputs if inputs.answer]
    assert all(inputs.step == inputs.cut_step + inputs.answer_frames for inputs in answered)
    total = sum(inputs.waited for inputs in session.inputs)
    assert (total > 0) == waits == (session.values['waited_for_cut'] > 0)
    assert total == pytest.approx(session.values['waited_for_cut_seconds'])


def test_a_session_in_one_process_is_cut_as_the_graph_cuts_it(
    scene: Scene, records: list[FrameRecord], prompt: Session
) -> None:
    assert in_process(scene, records) == prompt


@pytest.mark.parametrize('error', [SweepError, IndexError], ids=['refused', 'failed'])
def test_a_sweep_that_is_refused_stays_uncut_everywhere_and_one_that_fails_is_asked_for_again(
    node: node_module.TissueSimNode,
    scene: Scene,
    records: list[FrameRecord],
    prompt: Session,
    error: type[Exception],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    advance, calls = CombinedMethod.advance, itertools.count()

    def sometimes(self: Any, mesh: Any, positions: Any, sweep: Any) -> Any:
        if next(calls) % 4 == 0:
            raise error('as the test wants it')
        return advance(self, mesh, positions, sweep)

    monkeypatch.setattr(CombinedMethod, 'advance', sometimes)
    again = computed_again(recomputation(scene), records)
    assert again.cut > 50 and again != prompt
    calls = itertools.count()
    if error is SweepError:
        assert in_process(scene, records) == again
        calls = itertools.count()
        session = lived(node, scene, records, itertools.repeat(0.01), monkeypatch)
        assert session == again
        assert session.outcomes.count(CutOutcome.REFUSED) > 3
        assert session.values['refused cutting/cut: invalid sweep'] > 3
    else:
        assert issubclass(error, FAILURES)
        # The mesh of a cutting service that begins anew is another one, and so are last bits, which
        # faces in contact magnify.
        other = in_process(scene, records)
        np.testing.assert_allclose(other.forces, again.forces, atol=1e-5)


def test_a_service_that_falls_silent_holds_one_frame_back_and_is_asked_again_once_it_speaks(
    node: node_module.TissueSimNode,
    scene: Scene,
    records: list[FrameRecord],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = 20  # from then on the blade asks in each frame
    silent = iter([0.01] * before + [np.inf, np.inf, 0.3])
    delays = itertools.chain(silent, itertools.repeat(0.01))
    session = lived(node, scene, records, delays, monkeypatch)
    held = [inputs.waited for inputs in session.inputs if inputs.waited > 0.0]
    assert len(held) == 1 and held[0] == pytest.approx(1.0, abs=0.06)
    lost = [inputs.step for inputs in session.inputs if inputs.answer == CutOutcome.LOST]
    assert lost == list(range(lost[0], lost[0] + len(lost)))
    assert 35 < len(lost) < 50  # the rest of 1 s until it is called again, and 0.3 s
    aborts = [k for k, command in enumerate(session.commands) if command == Cut.Request.ABORT]
    assert aborts == [before + 1, before + 2]
    assert CutOutcome.APPLIED in session.outcomes[lost[-1] :]
    assert session.values['refused cutting/cut: no answer in time'] == 1
    assert session.values['refused cutting/cut: the service is silent'] == len(lost) - 1
