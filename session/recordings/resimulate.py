"""A recorded session, computed again: the same, or where it first differs; or with changes."""

import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from bags.comparison import Comparison, compare
from bags.reader import Bag, open_bag
from bags.resimulation import Recomputation
from cutting.methods import make_method
from cutting.warm_up import warm_up as warm_up_cutting
from haptic_bridge import chain
from session.errors import SessionError
from session.recordings.experiment import run_experiment
from session.recordings.recorded_scene import restore_scene
from session.scene import Scene, load_scene
from session.status import Status
from tissue_sim.assembly import make_simulation


def resimulate(folder: Path, changes: Mapping[str, str], *, as_json: bool = False) -> Status:
    """Computes a session again and says what came of it.

    Args:
        folder: of the bag.
        changes: by dotted key of the scene; without any the numbers must be those recorded.
        as_json: print what came of it as JSON.

    Raises:
        BagError, SessionError, SceneError, SettingsError: it cannot be computed.
    """
    bag = open_bag(folder)
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = load_scene(str(restore_scene(bag, Path(temporary))))
        warm_up_cutting(scene.cutting)
        if changes:
            changed = load_scene(str(restore_scene(bag, Path(temporary), changes)))
            warm_up_cutting(changed.cutting)
            return _experiment(bag, scene, changed, changes, as_json=as_json)
        return _verify(bag, scene, as_json=as_json)


def recomputation(scene: Scene) -> Recomputation:
    """Simulation and cutting of a scene, before the first frame.

    Raises:
        SessionError: the scene leaves the method to a plan, and what was planned is not known.
    """
    if scene.tissue.method == 'auto':
        raise SessionError(
            'tissue.method is auto, and the bag does not say what was planned, which depends on '
            'the speed of the machine: only a method that is known can be computed again'
        )
    simulation, _ = make_simulation(scene.tissue)
    return Recomputation(simulation, make_method(scene.cutting))


def pose_check(scene: Scene) -> Callable[[Any, Any], float]:
    """How far [m] the tool of a contact is from where a device pose puts it."""
    setup = chain.make_setup(scene.tool, scene.device, scene.haptics, scene.profile)
    state = np.zeros(1, chain.STATE)

    def distance(pose: Any, contact: Any) -> float:
        chain.to_tissue(setup, state, np.array(pose.values))
        root, tip = state[0]['blade']
        pairs = (
            (state[0]['tip'], contact.device),
            (root, contact.blade_root),
            (tip, contact.blade_tip),
        )
        return max(float(np.abs(now - then).max()) for now, then in pairs)

    return distance


def _verify(bag: Bag, scene: Scene, *, as_json: bool) -> Status:
    console, notes = Console(soft_wrap=True), Console(stderr=True)
    with Progress(console=notes, transient=True) as progress:
        bar = progress.add_task('computing frames')
        began = time.monotonic()
        result = compare(
            bag,
            recomputation(scene),
            pose_check(scene),
            lambda done, total: progress.update(bar, completed=done, total=total),
        )
        took = time.monotonic() - began
    if as_json:
        told = asdict(result) | {'identical': result.identical, 'computed_in': took}
        if result.difference and math.isinf(result.difference.size):
            told['difference']['size'] = None
        print(json.dumps(told, indent=2))
    else:
        console.print(*verdict(result, took), sep='\n', highlight=False)
    return Status.FAILED if result.difference else Status.OK


def verdict(result: Comparison, took: float) -> list[str]:
    """The outcome in lines.

    Args:
        result: of the comparison.
        took: computing time [s].
    """
    compared = (
        f'compared bit for bit: {result.frames} frames, {result.forces} forces, '
        f'{result.meshes} meshes, {result.hashes} mesh hashes, {result.poses} poses'
    )
    speed = f'{result.seconds:.1f} s of the session in {took:.1f} s'
    lacks = [f'not in the bag: {n} {what}' for what, n in result.missing.items()]
    lines = [compared, *lacks, speed]
    if result.restart is not None:
        lines.append(
            f'not compared: tissue_sim was started again, from frame {result.restart.step} '
            f'({result.restart.seconds:.2f} s) on, at a state that the bag does not have'
        )
    if result.difference is None:
        whole = 'identical'
        if (rounding := result.rounding) is not None:
            whole += ' but for rounding'
            lines.append(
                f'rounded otherwise from frame {rounding.step} ({rounding.seconds:.2f} s) on: '
                f'{escape(rounding.what)}; at most {result.largest:.1g} of what was recorded, as '
                'other processors and libraries do'
            )
        if result.restart is not None:
            whole += f' up to the restart at {result.restart.seconds:.2f} s'
        return [whole + (', as far as the bag can say' if result.missing else ''), *lines]
    where = f'frame {result.difference.step} ({result.difference.seconds:.2f} s)'
    if result.difference.lacks:
        where = f'identical for {result.frames} frames; not to be computed from {where} on'
    else:
        where = f'differs first at {where}'
    return [f'{where}: {escape(result.difference.what)}', *lines]


def _experiment(
    bag: Bag, scene: Scene, changed: Scene, changes: Mapping[str, str], *, as_json: bool
) -> Status:
    notes = Console(stderr=True)
    with notes.status('computing the session as recorded'):
        before = run_experiment(bag, scene, recomputation(scene))
    with notes.status('computing the session as changed'):
        after = run_experiment(bag, changed, recomputation(changed))
    if as_json:
        runs = {'recorded': before.figures(), 'changed': after.figures()}
        print(json.dumps({'changes': dict(changes), **runs}, indent=2))
    else:
        Console().print(before.table(after, changes))
    return Status.OK
