"""`bench fuzz`: send invalid messages to a session, and check that it goes on."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node
from rich.table import Column, Table

from bench.trials.chaos_verdict import force_failures
from bench.trials.fuzz_graph import EXCLUDED_SERVICES, Fuzzer, SentMessages
from bench.trials.fuzz_verdict import busiest_second, problems
from bench.trials.fuzz_watch import NodeObserver
from bench.trials.operator import Operator
from bench.trials.trial import Course, Running, TrialOptions, print_result, run_trial
from cutting_trainer.session.demo_command import new_bag
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import (
    LOCAL,
    recorder_command,
    simulation_nodes,
    viewer_command,
)
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.session.scene_overrides import write_changed

NODE, OPERATOR = 'fuzz', 'operator'
TOUCH_TIMEOUT_S = 60.0
"""The hand must feel force and cut within this time, before the first bad message and after all."""
STROKE_DURATION_S = 8.0
"""Duration of one press and cut."""
DISCOVERY_TIME_S = 4.0
"""Time after which every topic of the session is discovered and recorded."""
SETTLING_TIME_S = 1.0
"""Time after the last message before the final check starts."""
MAX_RECORDED_BYTES = 1 << 22
"""Size limit of recorded messages; some messages exceed it."""
MAX_DURATION_S, MAX_TIME_PER_MESSAGE_S = 600.0, 0.02
"""Longest duration, and the additional time for each message [s]."""
CHANGES = {'cutting.method': 'combined'}
"""Changes of the scene: these cuts remove no tissue, so that some is left for the last cut."""


@dataclass(frozen=True)
class FuzzOptions(TrialOptions):
    """Options of `fuzz`.

    Attributes:
        messages: number of messages.
        flood: [s] for which each topic of 1 kHz is flooded afterwards with 10 kHz.
        largest: [MB] of one message to each topic that can have so many.
        bag: folder of the new bag; None: a folder named after scene and time.
    """

    messages: int
    flood: float
    largest: float
    bag: Path | None


class FuzzedSession(Course):
    """Fuzzed session from its first contact to its last.

    Args:
        running: the session.
        scene: scene of the nodes.
        options: options of the command line.
    """

    def __init__(self, running: Running, scene: Scene, options: FuzzOptions) -> None:
        self.began = self.ended = np.inf
        self.afterwards = False
        self._options = options
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=running.domain)
        self._node = Node(
            NODE, context=self._context, start_parameter_services=False, enable_rosout=False
        )
        self.sent = SentMessages()
        self.operator = Operator(
            scene, running.domain, options.seed, STROKE_DURATION_S, self.sent.has
        )
        self.watch = NodeObserver(self._node, lambda: running.supervisor.pids, self.sent.has)
        self.fuzzer: Fuzzer | None = None
        self._due = self.operator.now + TOUCH_TIMEOUT_S

    def tick(self, _elapsed: float) -> bool:
        """Advance the session; return False at its end."""
        now = self.operator.now
        if not np.isfinite(self.began):
            return self._touch(now)
        assert self.fuzzer is not None
        if not np.isfinite(self.ended):
            if self.fuzzer.done:
                self.fuzzer.end()
                self.ended, self._due = now, now + TOUCH_TIMEOUT_S
            return True
        self.afterwards = self._felt_and_cut(self.ended + SETTLING_TIME_S)
        return not self.afterwards and now < self._due

    def end(self) -> None:
        """Leave the graph."""
        if self.fuzzer is not None:
            self.fuzzer.end()
        self.watch.end()
        self.operator.end()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def failures(self, scene: Scene) -> list[str]:
        """Return failures that are visible in messages."""
        if not np.isfinite(self.began) or self.fuzzer is None:
            return ['the hand did not press and cut before the first bad message']
        seen, now = self.operator.seen, time.time()
        said = [] if self.afterwards else ['the hand did not press and cut after the last one']
        return [
            *([self.fuzzer.problem] if self.fuzzer.problem else []),
            *force_failures(seen, [], scene.device.load_profile(), scene.arm.max_force),
            *self.watch.problems,
            *(f for name in sorted(self.watch.nodes) for f in self._of_node(name, now)),
            *said,
        ]

    def _of_node(self, name: str, now: float) -> list[str]:
        return problems(name, self.watch.nodes[name], now, self._options.largest)

    def _touch(self, now: float) -> bool:
        """Wait until the hand has pressed and cut; collect valid messages meanwhile."""
        if self.fuzzer is None:
            if now < DISCOVERY_TIME_S:
                return True
            self.fuzzer = Fuzzer(
                self._node,
                self._options.seed,
                (NODE, OPERATOR),
                self.sent,
                lambda: len(self.operator.seen.commanded),
            )
        self.fuzzer.hear()
        if self._felt_and_cut(0.0):
            self.watch.begin()
            self.began = now
            largest = round(self._options.largest * 1e6)
            self.fuzzer.start(self._options.messages, self._options.flood, largest)
            return True
        return now < self._due

    def _felt_and_cut(self, since: float) -> bool:
        """Return whether the hand has felt force, and the tissue was cut, after a time [s]."""
        seen = self.operator.seen
        felt = any(any(row[2:]) for row in reversed(seen.felt) if row[0] > since)
        cuts = [count for moment, count in seen.topologies if moment > since]
        return bool(cuts) and cuts[-1] > (cuts[0] if since else 0) and felt


def run_fuzz(options: FuzzOptions) -> Status:
    """Run the session, send invalid messages, and print the result.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene = load_scene(options.scene)
    bag = new_bag(options.bag, f'fuzz-{scene.name}')

    def report(course: FuzzedSession, outcome: Outcome) -> list[str]:
        for name, node in course.watch.nodes.items():
            log = bag / 'log' / f'{name}.log'
            node.busiest = busiest_second(log.read_text(errors='replace')) if log.exists() else 0
        failures = [*outcome.troubles, *course.failures(scene)]
        _report(course, failures, bag, as_json=options.as_json)
        return failures

    return run_trial(
        options,
        lambda folder: _nodes(write_changed(scene, folder, CHANGES), bag, options.seed, folder),
        lambda running: FuzzedSession(running, scene, options),
        report,
        seconds=MAX_DURATION_S + MAX_TIME_PER_MESSAGE_S * options.messages,
        bag=bag,
    )


def _nodes(scene: Path, bag: Path, seed: int, folder: Path) -> list[NodeCommand]:
    nodes = simulation_nodes(scene, seed, folder / 'tissue.checkpoint')
    viewer = viewer_command(scene, LOCAL, 0, session=False)
    recorder = recorder_command(scene, bag, seed)
    limit = ('-p', f'max_message:={MAX_RECORDED_BYTES}')
    return [viewer, *nodes, replace(recorder, argv=(*recorder.argv, *limit))]


def _report(course: FuzzedSession, failures: list[str], bag: Path, *, as_json: bool) -> None:
    fuzzer, seen = course.fuzzer, course.operator.seen
    nodes = dict(sorted(course.watch.nodes.items()))
    values = {
        'messages': fuzzer.messages.total() if fuzzer else 0,
        'topics': len(fuzzer.targets) if fuzzer else 0,
        'services': len(fuzzer.clients) if fuzzer else 0,
        'kinds': dict(fuzzer.kinds) if fuzzer else {},
        'answers': fuzzer.answers if fuzzer else 0,
        'seconds': round(course.ended - course.began, 1) if fuzzer else 0,
        'refused': sum(sum(node.refused.values()) for node in nodes.values()),
        'reasons': sum(len(node.refused) for node in nodes.values()),
        'commands seen': len(seen.commanded),
        'left out': [f'NODE/{name}' for name in EXCLUDED_SERVICES],
        'bag': str(bag),
    }
    by_node = {
        name: {
            'memory before [MB]': round(node.before),
            'memory at the end [MB]': round(node.after),
            'most memory [MB]': round(node.most),
            'longest silence [s]': round(node.silence, 2),
            'longest period of its loop [s]': round(node.period, 4),
            'most lines of the log in a second': node.busiest,
            'refused': node.refused,
        }
        for name, node in nodes.items()
    }
    table = Table(Column('node', no_wrap=True), *next(iter(by_node.values()), {}), box=None)
    for name, row in by_node.items():
        table.add_row(
            name, *map(str, (row | {'refused': sum(nodes[name].refused.values())}).values())
        )
    print_result(values, table, failures, more={'nodes': by_node}, as_json=as_json)
