"""Tissue, force loop and the link between them in one process, in simulated time.

Nothing here waits and nothing is random but by seed, so a session gives the same bits again. What
the nodes and their messages do in the graph is done here with the same cores: the contact that is
newest when a frame begins loads it, and its force and surface arrive when it has been computed.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cutting_trainer.cutting.method_interface import CutMethod, outcome_of
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.haptic_bridge.contact_values import Tick
from cutting_trainer.haptic_bridge.force_path import ForcePath
from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.node_common.cdr_codec import ContactCodec, StampedMessage
from cutting_trainer.node_common.operating_state import CrtkState
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.tissue_sim.contact.tool import (
    ContactState,
    CutOutcome,
    Frame,
    ToolContact,
    ToolMode,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta
from cutting_trainer.tissue_sim.simulation.cut_transaction import CutTransaction
from cutting_trainer.tissue_sim.simulation.simulation import TissueSimulation

TICK_S = 0.001
"""[s] of the force loop."""
_NS = 1_000_000
_START_NS = 10**9
_PLACES = ContactCodec.fields


@dataclass(frozen=True)
class LinkSettings:
    """Link between the force loop and the tissue, the same in both directions.

    Attributes:
        delay: [s] of each direction.
        loss: share of the messages that never arrive, each direction.
        jitter: [s] by which a message may be later than that, evenly spread.
        compute: [s] from the beginning of a frame to its answer.
        seed: of loss and jitter.
    """

    delay: float = 0.0
    loss: float = 0.0
    jitter: float = 0.0
    compute: float = 0.010
    seed: int = 0


class _Channel:
    """Deliver messages in order with delay and loss.

    A message that is held up holds up those behind it, as a reliable connection does.
    """

    def __init__(self, link: LinkSettings, delay: float, random: np.random.Generator) -> None:
        self._delay = delay / TICK_S
        self._link = link
        self._random = random
        self._queue: deque[tuple[int, Any]] = deque()

    def send(self, tick: int, message: Any) -> None:
        link = self._link
        if link.loss and self._random.random() < link.loss:
            return
        late = link.jitter / TICK_S * self._random.random() if link.jitter else 0.0
        self._queue.append((tick + round(self._delay + late), message))

    def arrived(self, tick: int) -> list[Any]:
        messages = []
        while self._queue and self._queue[0][0] <= tick:
            messages.append(self._queue.popleft()[1])
        return messages


class Tissue:
    """The simulation with its cuts, by the protocol of `tissue_sim` and `cutting`.

    Args:
        simulation: of the tissue.
        method: of cutting; None: nothing is cut.
    """

    def __init__(self, simulation: TissueSimulation, method: CutMethod | None = None) -> None:
        self.simulation = simulation
        self._method = method
        self._cut = CutTransaction(simulation)

    def frame(self, *contacts: ToolContact | None) -> Frame:
        """Return one frame under the contacts of the tools."""
        if self._cut.due:
            self._cut.resolve(*self._answer())
        frame = self.simulation.frame(*contacts)
        self._cut.ask(frame)
        return frame

    def _answer(self) -> tuple[CutOutcome, TopologyDelta | None]:
        if self._method is None:
            return CutOutcome.EMPTY, None
        assert self._cut.asked is not None
        return answer(self._method, self._cut.asked, self.simulation)


def answer(
    method: CutMethod, asked: Frame, simulation: TissueSimulation
) -> tuple[CutOutcome, TopologyDelta]:
    """Return the answer of `cutting` to the command of the newest frame.

    Args:
        method: of cutting.
        asked: a frame with a command.
        simulation: as that frame left it.
    """
    assert asked.command is not None
    outcome, result = outcome_of(
        method, simulation.mesh, simulation.positions, asked.command, asked.sweep
    )
    return outcome, result.delta


def tool_contact(values: Sequence[float]) -> ToolContact:
    """Return the contact of a tick, as it is published."""

    def get(name: str) -> np.ndarray:
        return np.array(values[_PLACES[name]], float)

    nodes, slots = np.unique(get('nodes').astype(np.int64), return_inverse=True)
    weights = np.bincount(slots, get('weights'), len(nodes))
    return ToolContact(
        state=ContactState(int(get('state')[0])),
        topology=int(get('topology')[0]),
        nodes=nodes[weights > 0],
        weights=weights[weights > 0],
        device=get('device'),
        offset=get('proxy') - get('point'),
        normal=get('normal'),
        stiffness=float(get('coupling_stiffness')[0]),
        radius=float(get('proxy_radius')[0]),
        blade_root=get('blade_root'),
        blade_tip=get('blade_tip'),
        sequence=int(get('sequence')[0]),
        external=get('external_force'),
        mode=ToolMode(int(get('mode')[0])),
        blade_facing=get('blade_facing'),
    )


class InProcess:
    """A force loop at 1 kHz and a tissue at its own rate, with a link between them.

    Args:
        path: the force loop.
        tissue: under it.
        rate: of the tissue [Hz].
        link: between the two.

    Attributes:
        frame: newest of the tissue, None before the first.
        ticks: that have passed.
    """

    def __init__(
        self, path: ForcePath, tissue: Tissue, rate: float, link: LinkSettings | None = None
    ) -> None:
        link = link or LinkSettings()
        random = np.random.default_rng(link.seed)
        self.path = path
        self.tissue = tissue
        self.frame: Frame | None = None
        self.ticks = 0
        self._rate = rate
        self._up = _Channel(link, link.delay, random)
        self._down = _Channel(link, link.delay + link.compute, random)
        self._frames = 0
        self._newest: tuple[int, tuple[float, ...]] | None = None
        self._latest: Surface | None = None
        self._surface = self._surface_now()
        self._sample: StampedMessage | None = None

    def tick(
        self,
        position: np.ndarray,
        orientation: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
    ) -> Tick:
        """Run one period of the force loop with the device at a pose.

        Args:
            position: [m], device frame, shape (3,).
            orientation: quaternion x y z w.
        """
        now = _START_NS + self.ticks * _NS
        for surface, sample in self._down.arrived(self.ticks):
            self._surface, self._sample = surface, sample
        pose = StampedMessage(now, '', (*map(float, position), *orientation))
        out = self.path.tick(
            now, state=CrtkState.ENABLED, pose=pose, sample=self._sample, surface=self._surface
        )
        if out.fault:
            raise RuntimeError(f'tick {self.ticks}: {out.fault}')
        self._sample = None
        self._up.send(self.ticks, (out.contact_stamp_ns, out.contact))
        self.ticks += 1
        if self.ticks * TICK_S * self._rate >= self._frames + 1 - 1e-9:
            self._simulate()
        return out

    def wait(self, seconds: float, position: np.ndarray) -> None:
        """Let time [s] pass with the device at rest at a position [m]."""
        for _ in range(round(seconds / TICK_S)):
            self.tick(position)

    def _simulate(self) -> None:
        self._frames += 1
        for message in self._up.arrived(self.ticks):
            self._newest = message
        stamp, values = self._newest or (0, None)
        contact = tool_contact(values) if values is not None else None
        frame = self.tissue.frame(contact)
        self.frame = frame
        surface = self._surface_now()
        sequence = contact.sequence if contact is not None else 0
        self._down.send(self.ticks, (surface, self._sample_of(frame, sequence, stamp)))

    def _surface_now(self) -> Surface:
        simulation = self.tissue.simulation
        self._latest = Surface(
            simulation.positions,
            simulation.mesh.triangles,
            revision=simulation.step,
            topology=simulation.mesh.topology,
            previous=self._latest,
        )
        return self._latest

    def _sample_of(self, frame: Frame, sequence: int, stamp: int) -> StampedMessage:
        topology = self.tissue.simulation.mesh.topology
        head = (frame.step, frame.step, topology, sequence, *divmod(stamp, 10**9))
        end = _START_NS + self.ticks * _NS
        return StampedMessage(end, 'tissue', (*head, *frame.felt))


def make_force_path(scene: Scene) -> ForcePath:
    """Return the force loop of a scene, before its first tick."""
    return ForcePath(
        scene.tool,
        scene.device,
        scene.haptics,
        scene.profile,
        friction=scene.tissue.material.dry_friction,
        constants=scene.tissue.blade_constants,
    )


def simulate(scene: str, link: LinkSettings | None = None) -> InProcess:
    """Return a scene's force loop and tissue, to be moved tick by tick.

    Args:
        scene: name of a scene in config/scenes, or path of a scene file.
        link: between the two; None: without delay and loss.

    Raises:
        SessionError: there is no such scene.
        SceneError, SettingsError, MeshError: the scene or its mesh cannot be used.
    """
    said = load_scene(scene)
    simulation, _ = make_simulation(said.tissue)
    tissue = Tissue(simulation, make_method(said.cutting))
    return InProcess(make_force_path(said), tissue, said.tissue.integration.rate, link)
