"""`trainer resimulate`: recompute a recorded session and compare it, or change its scene."""

import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from cutting_trainer.bags.comparison import Comparison, compare
from cutting_trainer.bags.metadata import recorded_code
from cutting_trainer.bags.reader import Bag, open_bag
from cutting_trainer.bags.recorded_frames import ToolRecord
from cutting_trainer.bags.repair import repair_note
from cutting_trainer.bags.resimulation import Resimulation
from cutting_trainer.bags.resimulation_start import ComputationStart, find_beginning
from cutting_trainer.cutting.memory import from_state as memory_of
from cutting_trainer.cutting.method_registry import make_method
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.haptic_bridge import force_kernels
from cutting_trainer.haptic_bridge.indexing import Indexing
from cutting_trainer.node_common.code_identity import CodeIdentity, identity_here
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.what_if import recorded_run, run_experiment
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.session.scene_overrides import load_changed
from cutting_trainer.tissue_sim.assembly import load_kernels, make_simulation
from cutting_trainer.tissue_sim.simulation.serialisation import StateError
from cutting_trainer.tissue_sim.simulation.state import from_state, shape_of

_OF_THE_BEGINNING = ('tissue.mesh', 'tissue.unit', 'tissue.fixed', 'tissue.stretch')
"""Keys that make the shape of a tissue as a session begins."""


def resimulate(folder: Path, changes: Mapping[str, str], *, as_json: bool = False) -> Status:
    """Recompute a session and print the comparison.

    Args:
        folder: folder of the bag.
        changes: changes of the scene by dotted key; without any the results must be the same.
        as_json: print the result as JSON.

    Raises:
        BagError, SessionError, SceneError, SettingsError: it cannot be recomputed.
    """
    bag = open_bag(folder)
    if (repaired := repair_note(bag.custom_data)) and (changes or as_json):
        print(repaired, file=sys.stderr)
    with tempfile.TemporaryDirectory(prefix='trainer-') as temporary:
        scene = load_scene(str(restore_scene(bag, Path(temporary))))
        warm_up_cutting(scene.cutting)
        if changes:
            changed = load_changed(restore_scene(bag, Path(temporary), changes), changes)
            warm_up_cutting(changed.cutting)
            refuse_lost_changes(bag, changes)
            return _experiment(bag, scene, changed, changes, as_json=as_json)
        return _verify(bag, scene, as_json=as_json)


def refuse_lost_changes(bag: Bag, keys: Collection[str]) -> None:
    """Refuse changes without effect on a bag that begins with the shape of a tissue.

    Args:
        bag: bag of the session.
        keys: dotted, of the changed values.

    Raises:
        SessionError: there is one.
    """
    lost = [key for key in keys if key in _OF_THE_BEGINNING]
    if lost and find_beginning(bag).tissue is not None:
        raise SessionError(
            f'{lost[0]} cannot be changed: the bag begins in mid-session, with its own mesh. '
            'Take a bag with the beginning of its session'
        )


def recomputation(
    scene: Scene, beginning: ComputationStart | None = None, *, changed: bool = False
) -> Resimulation:
    """Return simulation and cutting of a scene, before the first frame.

    Args:
        scene: recorded scene, or a changed one.
        beginning: initial state; None: the first frame of the session.
        changed: the scene is not that of the state: the tissue starts in its recorded shape, at
            rest, and without a tool in it.

    Raises:
        SessionError: the scene leaves the method to a plan, and the plan is unknown; or the state
            is of another version of the trainer.
    """
    if scene.tissue.method == 'auto':
        raise SessionError(
            'tissue.method is auto, and the bag does not name the planned method, which depends on '
            'the speed of the machine: only a known method can be recomputed'
        )
    method = make_method(scene.cutting)
    if beginning is None or beginning.tissue is None:
        return Resimulation(make_simulation(scene.tissue, tools=len(scene.tools))[0], method)
    load_kernels(scene.tissue)
    try:
        simulation = from_state(beginning.tissue)
        if changed:
            shape = shape_of(simulation)
            simulation, _ = make_simulation(scene.tissue, shape, tools=len(scene.tools))
            return Resimulation(simulation, method)
        computed = Resimulation(simulation, method)
        computed.lacks_memory = beginning.cutting is None
        if beginning.cutting is not None:
            memory = memory_of(beginning.cutting, method)
            mine, theirs = simulation.mesh, memory.mesh
            if not np.array_equal(mine.tetrahedra, theirs.tetrahedra):
                raise StateError('the state of cutting belongs to another mesh')
            computed.remember(memory.method, theirs)
    except StateError as error:
        raise SessionError(f'frame {beginning.step}, where the bag begins: {error}') from None
    return computed


def pose_check(scene: Scene) -> Callable[[ToolRecord, int], float]:
    """Return a function for the distance [m] between the tool of a contact and of a device pose."""
    setups = [
        force_kernels.make_setup(one.tool, one.device, one.haptics, one.profile)
        for one in scene.tools
    ]
    state = np.zeros(1, force_kernels.STATE)

    scenes = [Indexing.of(one.device.tissue_from_device) for one in scene.tools]

    def distance(tool: ToolRecord, number: int) -> float:
        contact, pose = tool.contact, tool.pose
        assert pose is not None
        (tool.indexing or scenes[number]).write(setups[number])
        force_kernels.to_tissue(setups[number], state, np.array(pose.values))
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
    beginning = find_beginning(bag)
    with Progress(console=notes, transient=True) as progress:
        bar = progress.add_task('computing frames')
        began = time.monotonic()
        result = compare(
            bag,
            recomputation(scene, beginning),
            pose_check(scene),
            lambda done, total: progress.update(bar, completed=done, total=total),
            beginning,
        )
        took = time.monotonic() - began
    code = recorded_code(bag.custom_data)
    if as_json:
        # asdict of Python 3.11 makes pairs the keys of a Counter.
        report = asdict(replace(result, missing=Counter())) | {'missing': dict(result.missing)}
        report |= {'identical': result.identical, 'computed_in': took}
        report['code'] = {
            'bag': code and asdict(code),
            'here': asdict(identity_here()),
            'differences': code and code.differences(identity_here()),
        }
        if result.difference and math.isinf(result.difference.size):
            report['difference']['size'] = None
        print(json.dumps(report, indent=2))
    else:
        lines = [*verdict(result, took, code), escape(repair_note(bag.custom_data))]
        console.print(*filter(None, lines), sep='\n', highlight=False)
    return Status.FAILED if result.difference else Status.OK


def verdict(result: Comparison, took: float, code: CodeIdentity | None) -> list[str]:
    """Return the result in lines.

    Args:
        result: result of the comparison.
        took: computing time [s].
        code: code that the bag names; None: it names none.
    """
    compared = (
        f'compared bit for bit: {result.frames} frames, {result.forces} forces, '
        f'{result.meshes} meshes, {result.hashes} mesh hashes, {result.poses} poses'
    )
    speed = f'{result.seconds:.1f} s of the session in {took:.1f} s'
    lacks = [f'not in the bag: {n} {kind}' for kind, n in result.missing.items()]
    lines = [compared, *lacks, speed]
    if result.begins > 1:
        lines.append(
            f'begins at frame {result.begins}, from the state of the tissue that was recorded there'
        )
    if result.doubled:
        lines.append(f'in the bag twice, and passed over: {result.doubled} messages')
    if result.restart is not None:
        lines.append(
            f'not compared: the tissue began again, at frame {result.restart.step} '
            f'({result.restart.seconds:.2f} s)'
        )
    if result.difference is None:
        whole = 'identical'
        if (rounding := result.rounding) is not None:
            here, size = identity_here(), f'{result.largest:.1g} of the recorded values'
            if code is not None and code.rounds_otherwise_only(here):
                whole += ' but for rounding, as other processors and libraries do'
            else:
                whole = f'not identical: off by no more than {size}'
            lines.append(
                f'off from frame {rounding.step} ({rounding.seconds:.2f} s) on, by at most {size}: '
                f'{escape(rounding.what)}'
            )
            lines += reasons(code)
        if result.restart is not None:
            whole += f' up to the restart at {result.restart.seconds:.2f} s'
        return [whole + (', as far as the bag can say' if result.missing else ''), *lines]
    where = f'frame {result.difference.step} ({result.difference.seconds:.2f} s)'
    if result.difference.lacks:
        where = f'identical for {result.frames} frames; not to be computed from {where} on'
    else:
        where = f'differs first at {where}'
        lines += reasons(code)
    return [f'{where}: {escape(result.difference.what)}', *lines]


def reasons(code: CodeIdentity | None) -> list[str]:
    """Return causes of a different result: differences of kernels, libraries and processor.

    Args:
        code: code that the bag names; None: it names none.
    """
    if code is None:
        return ['this bag does not name its code: whether that or the processor differs is unknown']
    same = 'kernels, libraries and processor are those that the bag names'
    return [escape(text) for text in code.differences(identity_here())] or [same]


def _experiment(
    bag: Bag, scene: Scene, changed: Scene, changes: Mapping[str, str], *, as_json: bool
) -> Status:
    notes = Console(stderr=True)
    with notes.status('computing the session as recorded'):
        beginning = find_beginning(bag)
        before, differs = recorded_run(bag, recomputation(scene, beginning))
    if differs is not None:
        notes.print(
            f'the tissue as recorded is not quite the recorded one: its force differs from frame '
            f'{differs} on; without --with this command says by how much',
            highlight=False,
        )
    with notes.status('computing the session as changed'):
        after = run_experiment(bag, changed, recomputation(changed, beginning, changed=True))
    if as_json:
        runs = {'recorded': before.figures(), 'changed': after.figures()}
        report = {'changes': dict(changes), 'differs_from_frame': differs, **runs}
        print(json.dumps(report, indent=2))
    else:
        Console().print(before.table(after, changes))
    return Status.OK
