"""`bench soak`: run many sessions on the same processes, and check the growth of resources."""

import shutil
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rich.table import Table

from bench.trials.chaos import bags_of
from bench.trials.chaos_verdict import force_failures
from bench.trials.operator import Operator
from bench.trials.trial import (
    Course,
    Running,
    TrialOptions,
    print_result,
    recorded_nodes,
    run_trial,
)
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import CUTTING_NODE, RECORDER_NODE, TISSUE_NODE
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.scene_loader import Scene, load_scene

RESTARTED_NODES = (RECORDER_NODE, TISSUE_NODE, CUTTING_NODE)
"""Nodes that restart with each session; the others, and all processes, go on."""
STEPS = (
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
)
SAMPLE_PERIOD_S = 5.0
"""Period of the samples of the processes."""
WARM_UP_SHARE = 0.2
"""Share of the duration that does not count: allocators and caches fill."""
MAX_RELATIVE_GROWTH = 0.05
"""Allowed relative growth from the first counted quarter to the last."""
TRANSITION_TIMEOUT_S = 60.0
"""Timeout of a lifecycle transition."""
MAX_ABSOLUTE_GROWTH = {'memory [MB]': 4.0, 'threads': 0.5, 'file handles': 2.0, 'DDS entities': 2.0}
"""Allowed absolute growth of each resource."""


@dataclass(frozen=True)
class Sample:
    """Sample of the resources of a process, or of the graph.

    Attributes:
        seconds: [s] since the start.
        subject: node of the process, or `graph`.
        values: values by the names of `MAX_ABSOLUTE_GROWTH`.
    """

    seconds: float
    subject: str
    values: dict[str, float]


@dataclass(frozen=True)
class SoakOptions(TrialOptions):
    """Options of `soak`.

    Attributes:
        minutes: duration [min].
        every: length of a session [s].
    """

    minutes: float
    every: float


def sample_process(name: str, pid: int, seconds: float) -> Sample | None:
    """Return memory, threads and open files of a process; None when it has ended."""
    try:
        status = Path(f'/proc/{pid}/status').read_text(encoding='utf-8')
        files = len(list(Path(f'/proc/{pid}/fd').iterdir()))
    except OSError:
        return None
    fields = dict(line.split(':', 1) for line in status.splitlines() if ':' in line)
    memory = float(fields['VmRSS'].split()[0]) / 1024
    values = {'memory [MB]': memory, 'threads': float(fields['Threads']), 'file handles': files}
    return Sample(seconds, name, values)


def entities(node: Node) -> int:
    """Return the number of publishers, subscriptions, services and clients of the graph."""
    count = 0
    for topic, _ in node.get_topic_names_and_types():
        count += node.count_publishers(topic) + node.count_subscribers(topic)
    for name, namespace in node.get_node_names_and_namespaces():
        count += len(node.get_service_names_and_types_by_node(name, namespace))
        count += len(node.get_client_names_and_types_by_node(name, namespace))
    return count


def growth_failures(samples: list[Sample]) -> list[str]:
    """Return a sentence for each resource that grew beyond its allowance after the warm-up."""
    series: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for sample in samples:
        for name, value in sample.values.items():
            series[sample.subject, name].append((sample.seconds, value))
    found = []
    for (subject, name), rows in series.items():
        first, last = quarters(np.array(rows))
        if (
            last
            > first * (1 + (MAX_RELATIVE_GROWTH if name == 'memory [MB]' else 0))
            + MAX_ABSOLUTE_GROWTH[name]
        ):
            found.append(f'{name} of {subject} grew from {first:.4g} to {last:.4g}')
    return found


def remove_old(bags: list[Path]) -> None:
    """Remove all bags but the two newest, by time: a recorder reuses free names."""
    there = [bag for bag in bags if bag.is_dir()]
    for old in sorted(there, key=lambda bag: bag.stat().st_mtime_ns)[:-2]:
        shutil.rmtree(old, ignore_errors=True)


def quarters(rows: np.ndarray) -> tuple[float, float]:
    """Return medians of the first and the last quarter of what counts, rows of time and value."""
    start, end = WARM_UP_SHARE * rows[-1, 0], rows[-1, 0]
    quarter = (end - start) / 4
    early = rows[(rows[:, 0] >= start) & (rows[:, 0] <= start + quarter), 1]
    return float(np.median(early)), float(np.median(rows[rows[:, 0] >= end - quarter, 1]))


class SoakedSession(Course):
    """Start session after session on the running processes, and sample their resources.

    Args:
        running: the session.
        scene: scene of the nodes.
        options: duration, and length of a session.

    Attributes:
        sessions: number of sessions.
        samples: samples of the resources.
        failures: refused transitions and unsafe forces, as sentences.
    """

    def __init__(self, running: Running, scene: Scene, options: SoakOptions) -> None:
        self.sessions, self.failures, self.samples = 1, list[str](), list[Sample]()
        self._running, self._options = running, options
        self._operator = Operator(scene, running.domain, options.seed)
        self._profile = scene.device.load_profile()
        self._clients = {
            name: self._operator.node.create_client(ChangeState, f'{name}/change_state')
            for name in RESTARTED_NODES
        }
        self._began, self._sample_due = time.monotonic(), 0.0
        self._due = options.every
        self._left: list[tuple[str, int]] = []
        self._answer: Any = None
        self._since = 0.0

    @property
    def minutes(self) -> float:
        """Return the time since the start [min]."""
        return (time.monotonic() - self._began) / 60

    def tick(self, elapsed: float) -> None:
        """Start the next transition when the present one is done; sample when it is time."""
        self._running.progress.tick(elapsed, 60 * self._options.minutes)
        self._renew(elapsed)
        if elapsed >= self._sample_due:
            self._sample_due += SAMPLE_PERIOD_S
            self._sample(elapsed)

    def end(self) -> None:
        """Leave the graph."""
        self._operator.end()
        self._judge()

    def _sample(self, elapsed: float) -> None:
        for name, pid in self._running.supervisor.pids.items():
            if (sample := sample_process(name, pid, elapsed)) is not None:
                self.samples.append(sample)
        graph = {'DDS entities': float(entities(self._operator.node))}
        self.samples.append(Sample(elapsed, 'graph', graph))

    def _renew(self, elapsed: float) -> None:
        if elapsed >= self._due and not self._left:
            self._due, self._since = self._due + self._options.every, elapsed
            self._judge()
            self._left = [(name, step) for step in STEPS for name in RESTARTED_NODES]
        if not self._left:
            return
        name, step = self._left[0]
        if self._answer is None:
            if self._clients[name].service_is_ready():
                request = ChangeState.Request(transition=Transition(id=step))
                self._answer = self._clients[name].call_async(request)
        elif self._answer.done():
            done, self._answer, self._since = self._answer.result().success, None, elapsed
            self._left.pop(0)
            if not done:
                self.failures.append(f'{name} refused transition {step} at {elapsed:.0f} s')
            if not self._left:
                self.sessions += 1
                remove_old(bags_of(self._running.folder / 'bag'))
            return
        if elapsed > self._since + TRANSITION_TIMEOUT_S:
            self._left, self._answer = [], None
            self.failures.append(f'{name} did not answer to transition {step} at {elapsed:.0f} s')

    def _judge(self) -> None:
        """Check all forces since the last call."""
        self.failures += force_failures(self._operator.take_seen(), [], self._profile)


def run_soak(options: SoakOptions) -> Status:
    """Run the sessions and print the growth.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene = load_scene(options.scene)

    def report(course: SoakedSession, outcome: Outcome) -> list[str]:
        failures = [*outcome.troubles, *growth_failures(course.samples), *course.failures]
        _report(course, failures, as_json=options.as_json)
        return failures

    return run_trial(
        options,
        lambda folder: recorded_nodes(scene, options, folder),
        lambda running: SoakedSession(running, scene, options),
        report,
        seconds=60 * options.minutes,
    )


def _report(course: SoakedSession, failures: list[str], *, as_json: bool) -> None:
    names = ('what', 'name', 'first', 'last')
    rows = []
    for subject in sorted({sample.subject for sample in course.samples}):
        own = [s for s in course.samples if s.subject == subject]
        for name in own[0].values:
            first, last = quarters(np.array([(s.seconds, s.values[name]) for s in own]))
            rows.append((subject, name, first, last))
    table = Table('process', 'resource', 'first quarter', 'last quarter', box=None)
    for subject, name, first, last in rows:
        table.add_row(subject, name.replace('[', r'\['), f'{first:.4g}', f'{last:.4g}')
    values = {'minutes': round(course.minutes, 1), 'sessions': course.sessions}
    more = {'quarters': [dict(zip(names, row, strict=True)) for row in rows]}
    print_result(values, table, failures, more=more, as_json=as_json)
