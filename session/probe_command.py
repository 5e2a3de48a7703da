"""`trainer probe-device`: check whether the bridge can use the connected arm."""

import json
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cutting_trainer.haptic_bridge.devices.convention import METRES
from cutting_trainer.haptic_bridge.devices.placement import HOLD_S, LIFT_M
from cutting_trainer.haptic_bridge.devices.probe_force import check_gain, check_push, check_release
from cutting_trainer.haptic_bridge.devices.probe_pose import (
    QUARTER_TURN_DEG,
    RULER_LENGTH_M,
    check_frame,
    check_rotation,
    check_ruler,
)
from cutting_trainer.haptic_bridge.devices.probe_stream import (
    DIRECTIONS,
    PUSH_FORCE_N,
    REQUESTED_MOVE_M,
    ProbeCheck,
    check_moves,
    check_stream,
    extent,
)
from cutting_trainer.haptic_bridge.emulated_arm.faults import DriverFaults
from cutting_trainer.haptic_bridge.scene_schema import DeviceProfile, DeviceSettings
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import ARM_NODE, arm_command, node_environment
from cutting_trainer.session.node_process import NodeProcess
from cutting_trainer.session.place_device import MOVE_TIMEOUT_S, Guide, hindrances

REST_TIME_S = 3.0
"""Time of recording the arm at rest [s]."""
_START_TIMEOUT_S = 60.0
_COLOURS = {'ok': 'green', 'wrong': 'bold red', 'unknown': 'yellow'}


@dataclass(frozen=True)
class Emulation:
    """Settings of the emulated arm of the probe: keys of the scene's sections, and faults of its
    driver (`cutting_trainer.haptic_bridge.emulated_arm.faults`).
    """

    arm: dict[str, Any] = field(default_factory=dict)
    device: dict[str, Any] = field(default_factory=dict)
    faults: str = ''


@dataclass(frozen=True)
class ProbeOptions:
    """Options of `probe-device`.

    Attributes:
        arm: namespace of the device.
        profile: file in config/devices, without .yaml.
        emulation: emulated arm to start; None: a device is connected.
        moves: ask for moves and a rotation, to find unit, handedness, scale and orientation.
        push: push with `PUSH`, to find direction and gain of the force, and whether the driver
            releases it.
        domain: ROS domain, or `free`.
        as_json: print the checks as JSON.
        force_topic: topic below `arm` on which the device takes the force.
        place: scene whose section `device` is to say where the device is; '': none.
        points: known points in that scene's tissue frame, as `x,y,z` [m]; (): the corners of its
            tissue's underside.
        metres: one unit of the positions [m], by the scene.
    """

    arm: str = 'arm'
    profile: str = 'emulated'
    emulation: Emulation | None = None
    moves: bool = True
    push: bool = False
    domain: int | Literal['free'] = 0
    as_json: bool = False
    force_topic: str = 'servo_cf'
    place: str = ''
    points: tuple[str, ...] = ()
    metres: float = 1.0


def run_probe(options: ProbeOptions) -> Status:
    """Probe an arm and print the checks.

    Raises:
        SessionError, SettingsError: an option is not valid.
    """
    notes = Console(stderr=True)
    try:
        DriverFaults.read(options.emulation.faults if options.emulation else '')
    except ValueError as error:
        raise SessionError(f'--faults: {error}') from None
    guide = None if not options.place else Guide.of(options.place, options.points)
    if guide is None:
        profile = DeviceSettings.model_construct(profile=options.profile).load_profile()
    else:
        profile, options = guide.profile, replace(options, metres=guide.metres)
    with reserved_domain(options.domain) as domain:
        # Here, for the ROS of this process, before its libraries read it.
        os.environ.update(node_environment(domain))
        with _emulated(options, domain, guide):
            try:
                checks = probe(options, profile, notes, guide)
            except KeyboardInterrupt:
                return Status.INTERRUPTED
    if guide is not None:
        checks.append(guide.write(checks))
    _show(checks, options, notes)
    return Status.FAILED if any(check.verdict == 'wrong' for check in checks) else Status.OK


def probe(
    options: ProbeOptions, profile: DeviceProfile, notes: Console, guide: Guide | None = None
) -> list[ProbeCheck]:
    """Run all checks of an arm in the ROS domain of the environment."""
    import rclpy

    from cutting_trainer.haptic_bridge.devices.probe_node import DeviceProbe

    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = DeviceProbe(options.arm, context, options.force_topic)
    try:
        return _checks(node, options, profile, notes, guide)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def _checks(
    node: Any,
    options: ProbeOptions,
    profile: DeviceProfile,
    notes: Console,
    guide: Guide | None,
) -> list[ProbeCheck]:
    checks = [node.find()]
    if checks[0].measured == 'none':
        return checks
    notes.print(f'Let go of the arm, or hold it still, for {REST_TIME_S:g} s.', highlight=False)
    poses = node.listen(REST_TIME_S)
    if poses is None:
        silent = f'{node.pose_topic} has a publisher that sends nothing: is the device on?'
        return [*checks, ProbeCheck('rate', 'wrong', 'silent', silent)]
    scaled = replace(poses, values=poses.values * [*[options.metres] * 3, 1.0, 1.0, 1.0, 1.0])
    checks += check_stream(scaled, profile, node.pose_topic)
    if guide is not None and hindrances(checks):
        return checks
    if options.emulation is not None and (guide is not None or options.moves or options.push):
        node.enable()
    if guide is not None:
        checks += guide.lead(node, notes)
    elif options.moves:
        moves = _moves(node, extent(poses.positions), notes)
        checks += check_moves(moves, node.pose_topic)
        if len(moves) == len(DIRECTIONS):
            checks += _scale_and_turn(node, moves, checks, extent(poses.positions), notes)
    if options.push:
        metres = _metres(checks) if guide is None else guide.metres
        checks += _push(node, metres, notes)
    return [*checks, check_frame(node.frames, node.pose_topic)]


def _metres(checks: list[ProbeCheck]) -> float:
    """Return one unit of the positions [m], by the check of the moves."""
    units = [c.measured.split()[1] for c in checks if c.name == 'unit' and c.measured]
    return METRES[units[0]] if units else 1.0


def _scale_and_turn(
    node: Any, moves: list[np.ndarray], checks: list[ProbeCheck], noise: float, notes: Console
) -> list[ProbeCheck]:
    notes.print(
        'Lay a ruler beside it. Put the tip to a mark, then move it along the ruler by '
        f'{1e3 * RULER_LENGTH_M:g} mm, and hold it still.',
        highlight=False,
    )
    ruler = node.await_move(noise, MOVE_TIMEOUT_S)
    found = check_ruler(ruler, _metres(checks), node.pose_topic)
    if any(c.name == 'handedness' and c.verdict != 'ok' for c in checks):
        why = 'the frame has to be right-handed first'
        return [*found, ProbeCheck('orientation', 'unknown', '', why)]
    notes.print(
        f'Turn the tool by {QUARTER_TURN_DEG:g} degrees about the vertical, counterclockwise seen '
        'from above. Then hold it still.',
        highlight=False,
    )
    before, after = node.await_rotation(MOVE_TIMEOUT_S)
    return [*found, check_rotation(before, after, moves[2], node.pose_topic)]


def _moves(node: Any, noise: float, notes: Console) -> list[np.ndarray]:
    moves: list[np.ndarray] = []
    for direction in DIRECTIONS:
        notes.print(
            f'Move the tip about {100 * REQUESTED_MOVE_M:g} cm {direction}, then hold it still.',
            highlight=False,
        )
        move = node.await_move(noise, MOVE_TIMEOUT_S)
        if move is None:
            break
        moves.append(move)
    return moves


def _push(node: Any, metres: float, notes: Console) -> list[ProbeCheck]:
    from cutting_trainer.haptic_bridge.devices.probe_node import ProbeError

    state = node.state()
    if state not in ('', 'ENABLED'):
        why = f'the device is {state}: enable it by its own tools, then push'
        return [ProbeCheck('force', 'unknown', state, why)]
    notes.print(f'Hold the arm loosely: it is pushed with {PUSH_FORCE_N:g} N along each axis.')
    try:
        pushes = node.push(metres)
    except ProbeError as error:
        return [ProbeCheck('force', 'unknown', 'stopped', str(error))]
    last = pushes.times, pushes.along, pushes.deflection, pushes.still_felt
    return [
        *check_push(pushes.forces, pushes.yields, node.force_topic, pushes.tool),
        *check_gain(pushes.forces, pushes.felt, node.felt_topic),
        *check_release(*last, node.force_topic),
    ]


@contextmanager
def _emulated(options: ProbeOptions, domain: int, guide: Guide | None) -> Iterator[None]:
    """Run the emulated arm for the probe, if requested."""
    if options.emulation is None:
        yield
        return
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / 'probe.yaml'
        content = emulated_scene(options.emulation, options.force_topic, guide, moves=options.moves)
        scene.write_text(json.dumps(content))
        faults = {'faults': options.emulation.faults} if options.emulation.faults else {}
        command = arm_command(scene, auto_enable=False, wait_for_bridge=False, **faults)
        arm = NodeProcess(command, Path(folder) / 'log' / 'arm.log', node_environment(domain))
        try:
            _await_ready(arm)
            yield
        finally:
            arm.send_group(signal.SIGKILL)
            arm.process.wait()
            arm.log.close()
            arm.pipe.close()


def emulated_scene(
    emulation: Emulation,
    force_topic: str,
    guide: Guide | None = None,
    *,
    moves: bool = True,
) -> dict[str, Any]:
    """Return a scene in which the hand does what is asked once the arm is enabled."""
    if guide is not None:
        start = [*guide.points[0, :2].tolist(), float(guide.points[0, 2]) + LIFT_M]
        return _scripted(emulation, force_topic, start, guide.goals, 3 * HOLD_S)
    if not moves:
        return _scripted(emulation, force_topic, [0.0] * 3, [{'position': [0.0] * 3}], 1.5)
    steps = np.vstack([REQUESTED_MOVE_M * np.eye(3), [-RULER_LENGTH_M, 0.0, 0.0]])
    goals: list[dict[str, Any]] = [{'position': p} for p in np.cumsum(steps, axis=0).tolist()]
    goals.append(goals[-1] | {'rpy_deg': [0.0, 0.0, QUARTER_TURN_DEG]})
    return _scripted(emulation, force_topic, [0.0, 0.0, 0.0], goals, 1.5)


def _scripted(
    emulation: Emulation,
    force_topic: str,
    start: list[float],
    goals: list[dict[str, Any]],
    seconds: float,
) -> dict[str, Any]:
    """Return a scene of a hand that takes some seconds for each goal, two thirds at rest."""
    phases: list[dict[str, Any]] = []
    for goal in goals:
        phases += [
            {'kind': 'approach', 'waypoints': [goal], 'share': 0.5},
            {'kind': 'rest', 'share': 1.0},
        ]
    device = {'force_topic': force_topic, **emulation.device}
    script = {'start': {'position': start}, 'seconds': seconds * len(goals), 'phases': phases}
    return {'arm': {'script': script, **emulation.arm}, 'device': device}


def _await_ready(arm: NodeProcess) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while not arm.ready:
        for line in arm.lines():
            arm.tail.append(line)
            arm.ready |= line == f'ready: {ARM_NODE}'
        if arm.reap() or time.monotonic() > deadline:
            raise SessionError(f'the emulated arm did not start: {" / ".join(arm.tail)}')
        time.sleep(0.02)


def _show(checks: list[ProbeCheck], options: ProbeOptions, notes: Console) -> None:
    if options.as_json:
        Console().out(json.dumps([asdict(check) for check in checks], indent=2), highlight=False)
    else:
        table = Table(title=f'{options.arm} as {options.profile}', box=box.SIMPLE_HEAD)
        for column in ('check', 'verdict', 'measured'):
            table.add_column(column, overflow='fold')
        for check in checks:
            verdict = f'[{_COLOURS[check.verdict]}]{check.verdict}[/]'
            table.add_row(check.name, verdict, escape(check.measured))
        Console().print(table)
    for check in checks:
        if check.sentence:
            notes.print(
                f'[{_COLOURS[check.verdict]}]{check.name}:[/] {escape(check.sentence)}',
                highlight=False,
            )
