"""`trainer view --bag`: show a recorded session in the browser, beside its recomputation."""

import os
import signal
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.resimulation import answer_frames, as_recorded
from cutting_trainer.bags.resimulation_start import computable_frames
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.recordings.recorded_hand import computable_poses, times_of_frame
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import recomputation, refuse_lost_changes
from cutting_trainer.recordings.what_if import Hand, closed_loop
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.in_process import make_force_path
from cutting_trainer.session.scene_loader import Scene
from cutting_trainer.session.scene_overrides import load_changed
from cutting_trainer.tissue_sim.contact.tool import Frame
from cutting_trainer.viewer.access_control import TOKEN_VARIABLE, link, make_gate
from cutting_trainer.viewer.bag_timeline import ComputedTissue
from cutting_trainer.viewer.recording import Recording, computed_beside, recorded_beside
from cutting_trainer.viewer.replay_page import ReplayPage


@dataclass(frozen=True)
class ReplayOptions:
    """Options of `view --bag`.

    Attributes:
        bag: folder of the bag.
        resimulate: recompute the session, and show both.
        changes: changes of the scene for the recomputation, by dotted key.
        beside: folder of another bag to show beside it; None: none.
        host, port: address and port of the page.
        allow_host: host names under which the page is served.
    """

    bag: Path
    resimulate: bool
    changes: Mapping[str, str]
    host: str
    port: int
    allow_host: Sequence[str] = ()
    beside: Path | None = None


def view_bag(options: ReplayOptions) -> Status:
    """Serve the page until the user ends it.

    Raises:
        BagError, SessionError, SceneError, PageError: an option or the bag is not valid.
    """
    notes, beside = Console(stderr=True), None
    host, port, names = options.host, options.port, options.allow_host
    gate = make_gate(host, names, os.environ.get(TOKEN_VARIABLE, ''))
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        bag = open_bag(options.bag)
        recording, scene = _recording(bag, Path(temporary), options.changes)
        if options.resimulate or options.changes:
            name = ', '.join(f'{k}={v}' for k, v in options.changes.items()) or 'computed again'
            refuse_lost_changes(bag, options.changes)
            computed = resimulated(bag, scene, notes, changed=bool(options.changes))
            beside = computed_beside(name, computed)
        elif options.beside is not None:
            other = open_recording(options.beside, Path(temporary) / 'beside')
            beside = recorded_beside(other, recording)
        page = ReplayPage(recording, beside, host, port, gate)
    with _interrupts() as seen:
        shown = link(host, page.server.port, names, gate.token)
        notes.print(f'page: {shown} (Ctrl-C ends it)', highlight=False, soft_wrap=True)
        page.run(lambda: bool(seen))
    page.server.stop()
    return Status.OK


def open_recording(bag: Path, folder: Path) -> Recording:
    """Return a recorded session.

    Args:
        bag: folder of the bag.
        folder: made, for its scene.

    Raises:
        BagError, SceneError: the bag or its scene is not valid.
    """
    folder.mkdir()
    return _recording(open_bag(bag), folder)[0]


def _recording(
    bag: Bag, folder: Path, changes: Mapping[str, str] | None = None
) -> tuple[Recording, Scene]:
    """Return a recorded session, and its scene with changes, whose file goes into a folder."""
    scene = load_changed(restore_scene(bag, folder, changes), changes or {})
    return Recording(bag, scene.tool, scene.device, scene.exercise), scene


def resimulated(bag: Bag, scene: Scene, notes: Console, *, changed: bool) -> ComputedTissue:
    """Recompute a session for the page.

    Args:
        bag: bag of the session.
        scene: recorded scene, or a changed one.
        notes: console for the progress.
        changed: the recorded hand acts on another tissue; else the recorded contacts load it.

    Raises:
        BagError: a frame cannot be computed.
    """
    warm_up_cutting(scene.cutting)
    beginning, records = computable_frames(bag)
    computed = recomputation(scene, beginning, changed=changed)
    tissue, origin = ComputedTissue(), first_time(bag)
    if changed:
        records, poses = computable_poses(bag)
        hand = Hand(make_force_path(scene))
        times = [times_of_frame(record) for record in records]
        computed.answer_frames = answer_frames(records)
        frames: Iterator[Frame] = (frame for frame, _ in closed_loop(poses, times, hand, computed))
    else:
        frames = as_recorded(records, computed)
    with Progress(console=notes, transient=True) as progress:
        pairs = zip(records, frames, strict=True)
        for record, frame in progress.track(pairs, len(records), description='computing frames'):
            force = float(np.linalg.norm(frame.force))
            tissue.add((record.time - origin) * 1e-9, computed.simulation, force)
    return tissue


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Yield a list that grows with each signal that asks for the end."""
    seen: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {n: signal.signal(n, lambda number, _: seen.append(number)) for n in numbers}
    try:
        yield seen
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
