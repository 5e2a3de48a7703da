"""`bench chaos`: run a session under random faults; check its safety and its recovery."""

import signal
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.table import Table

from bench.trials.chaos_verdict import (
    Fault,
    FaultKind,
    Observations,
    force_failures,
    lost_cuts,
    not_recovered,
)
from bench.trials.operator import FAULTS, Operator
from bench.trials.trial import (
    Course,
    Running,
    TrialOptions,
    print_result,
    recorded_nodes,
    run_trial,
)
from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.session.demo_command import new_bag
from cutting_trainer.session.exit_status import Status
from cutting_trainer.session.node_commands import RECORDER_NODE
from cutting_trainer.session.outcome import Outcome
from cutting_trainer.session.scene_loader import Scene, load_scene

QUIET_TIME_S = 12.0
"""Time without faults before the first one and after the last [s]."""
FREEZE_RANGE_S = 0.02, 3.0
"""Shortest and longest stop of a node [s]."""
RECOVERY_TIMEOUT_S = 120.0
"""Time for the recovery after the nominal end [s]."""
MAX_NODES_DOWN = 2
"""Largest number of nodes that are down at the same time."""


@dataclass(frozen=True)
class ChaosOptions(TrialOptions):
    """Options of `chaos`.

    Attributes:
        minutes: duration [min].
        faults: number of faults.
        bag: folder of the new bag; None: a folder named after scene and time.
    """

    minutes: float
    faults: int
    bag: Path | None


class FaultInjector(Course):
    """Inject faults into the nodes of a session at random times.

    Args:
        running: the session.
        scene: scene of the nodes.
        options: number, seed and duration of the faults.

    Attributes:
        operator: operator that publishes the faults; it has the clock.
        faults: faults that have ended.
    """

    def __init__(self, running: Running, scene: Scene, options: ChaosOptions) -> None:
        self.operator = operator = Operator(scene, running.domain, options.seed)
        self.faults: list[Fault] = []
        self._supervisor = running.supervisor
        self._random = np.random.default_rng(options.seed)
        begin = operator.now + QUIET_TIME_S
        end = operator.now + 60 * options.minutes - QUIET_TIME_S
        self._due = sorted(self._random.uniform(begin, end, options.faults).tolist())
        self._over = begin
        self._thaw: dict[str, tuple[int, float, float]] = {}
        self._down: dict[str, tuple[FaultKind, float]] = {}

    def tick(self, _elapsed: float) -> bool:
        """Inject faults that are due; return False after the last one and the time for recovery."""
        now = self.operator.now
        for name, (process, began, ends) in list(self._thaw.items()):
            if now >= ends:
                del self._thaw[name]
                if self._supervisor.pids.get(name) == process:
                    self._supervisor.signal(name, signal.SIGCONT)
                self.faults.append(Fault('freeze', name, began, now))
                self._over = now + QUIET_TIME_S
        while self._due and now >= self._due[0] and self._strike():
            self._due.pop(0)
        return bool(self._due or self._thaw or self._down) or now < self._over

    def ready(self, name: str) -> None:
        """Register a node that is ready again."""
        if name in self._down:
            kind, began = self._down.pop(name)
            self.faults.append(Fault(kind, name, began, self.operator.now))
            self._over = self.operator.now + QUIET_TIME_S

    def end(self) -> None:
        """Leave the graph."""
        self.operator.end()

    def unfinished(self) -> list[Fault]:
        """Return the faults of nodes that have not recovered at the end."""
        return [Fault(kind, name, began, np.inf) for name, (kind, began) in self._down.items()]

    def _strike(self) -> bool:
        away = self._down.keys() | self._thaw.keys()
        well = [name for name in self._supervisor.pids if name not in away]
        if len(away) >= MAX_NODES_DOWN or not well:
            return False
        name = str(self._random.choice(well))
        kinds: tuple[FaultKind, ...] = get_args(FaultKind)
        kind = kinds[self._random.choice(len(kinds), p=(0.4, 0.4, 0.2))]
        self.operator.log_fault(f'{kind} {name}')
        process = self._supervisor.pids[name]
        signals = {'kill': signal.SIGKILL, 'end': signal.SIGTERM, 'freeze': signal.SIGSTOP}
        self._supervisor.signal(name, signals[kind])
        began = self.operator.now  # not before: telling takes its time, and frames go on
        if kind == 'freeze':
            self._thaw[name] = process, began, began + float(self._random.uniform(*FREEZE_RANGE_S))
        else:
            self._down[name] = kind, began
        return True


def run_chaos(options: ChaosOptions) -> Status:
    """Run the session, inject the faults and print the result.

    Raises:
        SessionError, SceneError, SettingsError: it cannot be run like this.
    """
    scene = load_scene(options.scene)
    bag = new_bag(options.bag, f'chaos-{scene.name}')

    def report(injector: FaultInjector, outcome: Outcome) -> list[str]:
        faults = sorted([*injector.faults, *injector.unfinished()], key=lambda fault: fault.began)
        seen = injector.operator.seen
        failures = [
            *force_failures(seen, faults, scene.device.load_profile()),
            *lost_cuts(seen),
            *not_recovered(faults),
            *outcome.kills,
            *_unread(bag, outcome.interrupted, faults),
            *_idle(seen, faults),
        ]
        _report(faults, seen, failures, bag, as_json=options.as_json)
        return failures

    return run_trial(
        options,
        lambda folder: recorded_nodes(scene, options, folder, bag),
        lambda running: FaultInjector(running, scene, options),
        report,
        seconds=60 * options.minutes + RECOVERY_TIMEOUT_S,
        bag=bag,
        restart=True,
    )


def _idle(seen: Observations, faults: list[Fault]) -> list[str]:
    """Return whether the hand felt tissue again after the last fault, and the tissue was cut at
    all.
    """
    last = max((f.ended for f in faults if np.isfinite(f.ended)), default=0.0)
    found = []
    if not any(row[0] > last + 1.0 and any(row[2:]) for row in seen.felt):
        found.append('the hand felt nothing any more after the last fault')
    if not seen.topologies or not seen.topologies[-1][1]:
        found.append('nothing was cut')
    return found


def bags_of(bag: Path) -> list[Path]:
    """Return the bag, and the bags of restarted recorders beside it."""
    later = [path for path in bag.parent.glob(f'{bag.name}-*') if path.is_dir()]
    return [bag, *sorted(later, key=lambda path: (len(path.name), path.name))]


def _unread(bag: Path, interrupted: bool, faults: list[Fault]) -> list[str]:
    """Return failures of the record: a fault must be in a bag, if its recorder ran."""
    told: set[str] = set()
    found = []
    for folder in bags_of(bag):
        try:
            recorded = open_bag(folder)
            told |= {
                f'{m.publish_time}:{recorded.read(m).data}'
                for m in recorded.messages([f'/{FAULTS}'])
            }
        except BagError as error:
            found.append(str(error))
    words = [said.partition(':')[2] for said in told]
    heard = [f for f in faults if not _recorder_away(f, faults)]
    for kind, node in {(f.kind, f.node) for f in heard}:
        done = sum(f.kind == kind and f.node == node for f in heard)
        said = words.count(f'{kind} {node}')
        if said < done and not interrupted:
            found.append(f'{kind} {node} was done {done} times, of which the bags tell {said}')
    return found


def _recorder_away(fault: Fault, faults: list[Fault]) -> bool:
    return any(
        f.node == RECORDER_NODE and f.began - 0.5 <= fault.began <= f.ended + 1.0 for f in faults
    )


def _report(
    faults: list[Fault], seen: Observations, failures: list[str], bag: Path, *, as_json: bool
) -> None:
    down = [f.ended - f.began for f in faults if f.kind != 'freeze']
    values: Mapping[str, Any] = {
        'faults': len(faults),
        'commands seen': len(seen.commanded),
        'longest absence of a node [s]': round(max(down, default=0.0), 2),
        'changes by cuts': seen.topologies[-1][1] if seen.topologies else 0,
        'bags': [str(path) for path in bags_of(bag)],
    }
    table = Table('fault', 'node', 'at [s]', 'back after [s]', box=None)
    for f in faults:
        table.add_row(f.kind, f.node, f'{f.began:.1f}', f'{f.ended - f.began:.2f}')
    more = {'all': [asdict(f) for f in faults]}
    print_result(values, table, failures, more=more, as_json=as_json)
