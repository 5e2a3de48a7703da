"""`trainer view --bag`: a recorded session in the browser, and one computed again beside it."""

import signal
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from bags.frames import FrameRecord, read_frames
from bags.player import first_time
from bags.reader import Bag, open_bag
from bags.resimulation import Recomputation
from bags.topics import POSE, of_session
from cutting.warm_up import warm_up as warm_up_cutting
from haptic_bridge.force_path import ForcePath
from haptic_bridge.wire import PoseStampedCodec
from session.errors import SessionError
from session.recordings.experiment import Hand, closed_loop, time_of_contact
from session.recordings.recorded_scene import restore_scene
from session.recordings.resimulate import recomputation
from session.scene import Scene, load_scene
from session.status import Status
from tissue_sim.contact import Frame
from tissue_sim.tool_contact import tool_contact
from viewer.page import addresses
from viewer.replay_page import ReplayPage
from viewer.tracks import ComputedTissue


@dataclass(frozen=True)
class ReplayOptions:
    """What the command line says.

    Attributes:
        bag: its folder.
        resimulate: compute the session again, and show that beside it.
        changes: of the scene for that, by dotted key.
        host, port: where the page is served.
    """

    bag: Path
    resimulate: bool
    changes: Mapping[str, str]
    host: str
    port: int


def view_bag(options: ReplayOptions) -> Status:
    """Serves the page until the user ends it.

    Raises:
        BagError, SessionError, SceneError, PageError: it cannot be shown like this.
    """
    bag = open_bag(options.bag)
    notes = Console(stderr=True)
    computed, name = None, ''
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = load_scene(str(restore_scene(bag, Path(temporary), options.changes)))
        if options.resimulate or options.changes:
            name = ', '.join(f'{k}={v}' for k, v in options.changes.items()) or 'computed again'
            computed = resimulated(bag, scene, notes, changed=bool(options.changes))
        page = ReplayPage(bag, scene.tool, scene.device, computed, name, options.host, options.port)
    with _interrupts() as seen:
        notes.print(f'page: {addresses(page.server)} (Ctrl-C ends it)', highlight=False)
        page.run(lambda: bool(seen))
    page.server.stop()
    return Status.OK


def resimulated(bag: Bag, scene: Scene, notes: Console, *, changed: bool) -> ComputedTissue:
    """Computes a session again, to look at.

    Args:
        bag: of the session.
        scene: as recorded, or changed.
        notes: for the progress.
        changed: the recorded hand meets another tissue; else the recorded contacts load it.

    Raises:
        SessionError: a frame cannot be computed.
    """
    warm_up_cutting(scene.cutting)
    computed, records = recomputation(scene), read_frames(bag)
    tissue, origin = ComputedTissue(), first_time(bag)
    if changed:
        codec, topic = PoseStampedCodec(), of_session(POSE, bag.topics())
        poses = [codec.decode(recorded.data) for recorded in bag.messages([topic])]
        hand = Hand(ForcePath(scene.tool, scene.device, scene.haptics, scene.profile))
        untils = [time_of_contact(record) for record in records]
        frames: Iterator[Frame] = (frame for frame, _ in closed_loop(poses, untils, hand, computed))
    else:
        frames = _as_recorded(records, computed)
    with Progress(console=notes, transient=True) as progress:
        pairs = zip(records, frames, strict=True)
        for record, frame in progress.track(pairs, len(records), description='computing frames'):
            force = float(np.linalg.norm(frame.force))
            tissue.add((record.time - origin) * 1e-9, computed.simulation, force)
    return tissue


def _as_recorded(records: list[FrameRecord], computed: Recomputation) -> Iterator[Frame]:
    for record in records:
        if what := computed.take_answer(record.answer):
            raise SessionError(f'frame {record.step} cannot be computed again: {what}')
        if record.has_contact and record.contact is None:
            raise SessionError(f'the bag lacks the contact of frame {record.step}')
        mesh = computed.simulation.mesh
        yield computed.frame(record.contact and tool_contact(record.contact, mesh))


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """The signals that ask for the end, as they come."""
    seen: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {n: signal.signal(n, lambda number, _: seen.append(number)) for n in numbers}
    try:
        yield seen
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
