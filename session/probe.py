"""The command `probe-device`: is the arm that is connected one that the bridge can use?"""

import json
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from haptic_bridge.probe import (
    ASKED_MOVE,
    DIRECTIONS,
    PUSH,
    Check,
    check_moves,
    check_push,
    check_stream,
    extent,
)
from haptic_bridge.settings import DeviceProfile, DeviceSettings
from session.domain import reserved_domain
from session.errors import SessionError
from session.graph import ARM_NODE, arm_command, node_environment
from session.node_process import NodeProcess
from session.status import Status

STILL = 3.0
"""[s] of listening while nobody moves the arm."""
TIME_TO_MOVE = 30.0
"""[s] for each move."""
_STARTING = 60.0
_COLOURS = {'ok': 'green', 'wrong': 'bold red', 'unknown': 'yellow'}
_METRES = {'m': 1.0, 'dm': 0.1, 'cm': 0.01, 'mm': 0.001}


@dataclass(frozen=True)
class Emulation:
    """What the emulated arm is like that the probe starts: keys of the scene's sections."""

    arm: dict[str, Any] = field(default_factory=dict)
    device: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ProbeOptions:
    """What the command line says.

    Attributes:
        arm: namespace of the device.
        profile: file in config/devices, without .yaml.
        emulation: the arm to start; None: one is connected.
        moves: ask for three moves, which tell unit and handedness.
        push: push with `PUSH`, which tells the sign of the force.
        domain: ROS domain, or `free`.
        as_json: print the checks as JSON.
    """

    arm: str = 'arm'
    profile: str = 'emulated'
    emulation: Emulation | None = None
    moves: bool = True
    push: bool = False
    domain: int | Literal['free'] = 0
    as_json: bool = False


def run_probe(options: ProbeOptions) -> Status:
    """Probes an arm and prints what was found.

    Raises:
        SessionError, SettingsError: it cannot be done as asked.
    """
    notes = Console(stderr=True)
    profile = DeviceSettings.model_construct(profile=options.profile).load_profile()
    with reserved_domain(options.domain) as domain:
        # Here, for the ROS of this process, before its libraries read it.
        os.environ.update(node_environment(domain))
        with _emulated(options, domain):
            try:
                checks = probe(options, profile, notes)
            except KeyboardInterrupt:
                return Status.INTERRUPTED
    _show(checks, options, notes)
    return Status.FAILED if any(check.verdict == 'wrong' for check in checks) else Status.OK


def probe(options: ProbeOptions, profile: DeviceProfile, notes: Console) -> list[Check]:
    """All checks of an arm in the ROS domain of the environment."""
    import rclpy

    from haptic_bridge.probe_node import DeviceProbe

    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = DeviceProbe(options.arm, context)
    try:
        return _checks(node, options, profile, notes)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def _checks(
    node: Any, options: ProbeOptions, profile: DeviceProfile, notes: Console
) -> list[Check]:
    checks = [node.find()]
    if checks[0].measured == 'none':
        return checks
    notes.print(f'Let go of the arm, or hold it still, for {STILL:g} s.', highlight=False)
    poses = node.listen(STILL)
    if poses is None:
        silent = f'{node.pose_topic} has a publisher that sends nothing: is the device on?'
        return [*checks, Check('rate', 'wrong', 'silent', silent)]
    checks += check_stream(poses, profile, node.pose_topic)
    if options.moves:
        if options.emulation is not None:
            node.enable()
        moves = _moves(node, extent(poses.positions), notes)
        checks += check_moves(moves, node.pose_topic)
    if options.push:
        checks += _push(node, checks, notes)
    return checks


def _moves(node: Any, noise: float, notes: Console) -> list[np.ndarray]:
    moves: list[np.ndarray] = []
    for direction in DIRECTIONS:
        notes.print(
            f'Move the tip about {100 * ASKED_MOVE:g} cm {direction}, then hold it still.',
            highlight=False,
        )
        move = node.await_move(noise, TIME_TO_MOVE)
        if move is None:
            break
        moves.append(move)
    return moves


def _push(node: Any, checks: list[Check], notes: Console) -> list[Check]:
    from haptic_bridge.probe_node import ProbeError

    state = node.state()
    if state not in ('', 'ENABLED'):
        why = f'the device is {state}: enable it by its own tools, then push'
        return [Check('force', 'unknown', state, why)]
    notes.print(f'Hold the arm loosely: it is pushed with {PUSH:g} N along each axis.')
    units = [c.measured.split()[1] for c in checks if c.name == 'unit' and c.measured]
    try:
        forces, yields = node.push(_METRES[units[0]] if units else 1.0)
    except ProbeError as error:
        return [Check('force', 'unknown', 'broken off', str(error))]
    return check_push(forces, yields, node.force_topic)


@contextmanager
def _emulated(options: ProbeOptions, domain: int) -> Iterator[None]:
    """Runs the emulated arm for the probe, where that is asked for."""
    if options.emulation is None:
        yield
        return
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / 'probe.yaml'
        scene.write_text(json.dumps(emulated_scene(options.emulation)))
        command = arm_command(scene, auto_enable=False, wait_for_bridge=False)
        arm = NodeProcess(command, Path(folder) / 'log' / 'arm.log', node_environment(domain))
        try:
            _await_ready(arm)
            yield
        finally:
            arm.send_group(signal.SIGKILL)
            arm.process.wait()
            arm.log.close()
            arm.pipe.close()


def emulated_scene(emulation: Emulation) -> dict[str, Any]:
    """A scene in which the hand makes the three moves, when the arm is enabled."""
    points = np.cumsum(ASKED_MOVE * np.eye(3), axis=0).tolist()
    phases: list[dict[str, Any]] = []
    for point in points:
        phases += [
            {'kind': 'approach', 'waypoints': [{'position': point}], 'share': 0.5},
            {'kind': 'rest', 'share': 1.0},
        ]
    script = {'start': {'position': [0.0, 0.0, 0.0]}, 'seconds': 4.5, 'phases': phases}
    return {'arm': {'script': script, **emulation.arm}, 'device': emulation.device}


def _await_ready(arm: NodeProcess) -> None:
    deadline = time.monotonic() + _STARTING
    while not arm.ready:
        for line in arm.lines():
            arm.tail.append(line)
            arm.ready |= line == f'ready: {ARM_NODE}'
        if arm.reap() or time.monotonic() > deadline:
            raise SessionError(f'the emulated arm did not start: {" / ".join(arm.tail)}')
        time.sleep(0.02)


def _show(checks: list[Check], options: ProbeOptions, notes: Console) -> None:
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
