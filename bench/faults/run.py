"""The faults command: plant each drawn fault, run the tests, and keep who found it."""

import json
import signal
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.faults.candidates import Fault, draw
from bench.faults.copy import Copy, Outcome
from bench.faults.suspects import likely_tests
from cutting_trainer.session.exit_status import Status

ROUNDS = ('quick', 'nearest', 'near', 'usual', 'all')
"""Rounds of tests: the quick ones of the files most likely to find it, all of the most likely
files, the next ones, the rest of `./trainer test`, and those of `--all` alone."""
MAX_QUICK, MAX_NEAREST, MAX_NEAR = 8, 4, 16
"""Test files of the first round, of the second, and of the second and third."""
FOUND, SURVIVED = 'found', 'survived'


@dataclass
class Trial:
    """One line of the state: a fault, and who found it.

    Attributes:
        number: in the draw.
        fault: to plant.
        verdict: `found`, `survived`, or empty before the first round.
        round: the last that was run to its end.
        test: that found it.
        timed_out: whether a limit of time ended that test.
        seconds: of all rounds.
        unreliable: tests that failed without the fault, too, and do not count.
    """

    number: int
    fault: Fault
    verdict: str = ''
    round: str = ''
    test: str = ''
    timed_out: bool = False
    seconds: float = 0.0
    unreliable: list[str] = field(default_factory=list)


def load_trials(file: Path, new: Callable[[], list[Fault]]) -> list[Trial]:
    """Return the trials of a state file, one on each line; new ones where there is no file."""
    if not file.is_file():
        trials = [Trial(number, fault) for number, fault in enumerate(new())]
        save_trials(file, trials)
        return trials
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    return [Trial(**row | {'fault': Fault(**row['fault'])}) for row in rows]


def save_trials(file: Path, trials: list[Trial]) -> None:
    """Write the state so that an interruption leaves the old one or the new one."""
    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_suffix('.new')
    new.write_text(''.join(json.dumps(asdict(trial)) + '\n' for trial in trials))
    new.replace(file)


def is_due(trial: Trial, name: str) -> bool:
    """Return whether a round is still to be run for a trial."""
    done = ROUNDS.index(trial.round) if trial.round else -1
    return trial.verdict != FOUND and done < ROUNDS.index(name)


def try_round(trial: Trial, name: str, copy: Copy) -> None:
    """Run one round for one fault: the first test that fails with it, and not without, found it."""
    ordered = likely_tests(copy.root, trial.fault)
    tests = {
        'quick': ordered[:MAX_QUICK],
        'nearest': ordered[:MAX_NEAREST],
        'near': ordered[MAX_NEAREST:MAX_NEAR],
        'usual': ordered[MAX_NEAR:],
        'all': ordered,
    }[name]
    options = ('-m', 'thorough') if name == 'all' else ()
    tier = name if name in ('quick', 'all') else 'usual'
    while True:
        left_out = [f'--deselect={test}' for test in trial.unreliable]
        outcome = copy.run(tests, tier, trial.number, trial.fault, *options, *left_out)
        trial.seconds += round(outcome.seconds, 1)
        if outcome.failed is None:
            trial.verdict, trial.round = SURVIVED, name
            return
        if finds(outcome, trial, copy):
            trial.verdict, trial.round, trial.test = FOUND, name, outcome.failed
            trial.timed_out = outcome.timed_out
            return
        trial.unreliable.append(outcome.failed)


def finds(outcome: Outcome, trial: Trial, copy: Copy) -> bool:
    """Return whether a test fails again with the fault, and passes without it."""
    if outcome.failed is None or not outcome.failed.startswith('test/'):
        # Nothing could be collected: no test of the sound copy does that.
        return True
    test = [outcome.failed]
    if not outcome.timed_out and not copy.run(test, 'all', trial.number, trial.fault).failed:
        return False
    return copy.run(test, 'all', trial.number, None).failed is None


def run_faults(checkout: Path, folder: Path, count: int, seed: int, last: str) -> Status:
    """Run the rounds up to `last` for every fault, and print who found each.

    Args:
        checkout: the last commit of it is examined.
        folder: for the state, `seed-S.jsonl`, and the copy; an interrupted run goes on.
        count: faults to draw.
        seed: of the draw.
        last: of `ROUNDS`.

    Returns:
        `FAILED` where a fault survives the tier that `./trainer test` runs.
    """
    # Ends like Ctrl-C, so that no test outlives it.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console, state = Console(), folder / f'seed-{seed}.jsonl'
    copy = Copy(checkout, folder)
    if sentence := copy.other_commit():
        console.print(sentence, markup=False, highlight=False, soft_wrap=True)
        return Status.FAILED
    trials = load_trials(state, lambda: draw(copy.root, count, seed))
    for name in ROUNDS[: ROUNDS.index(last) + 1]:
        # Those without kernels come first: nothing is compiled again for them.
        for trial in sorted(trials, key=lambda trial: trial.fault.kernel):
            if is_due(trial, name):
                try_round(trial, name, copy)
                save_trials(state, trials)
                fault = trial.fault
                place = f'{fault.path}:{fault.line} {fault.kind}'
                console.print(
                    f'{trial.number} {place}: {trial.verdict} ({trial.round}) {trial.test}',
                    markup=False,
                    highlight=False,
                    soft_wrap=True,
                )
    console.print(table(trials))
    survivors = [trial for trial in trials if trial.verdict == SURVIVED]
    return Status.FAILED if survivors else Status.OK


def table(trials: list[Trial]) -> Table:
    """Return a row for each fault with the round and the test that found it, and seconds."""
    found = [trial for trial in trials if trial.verdict == FOUND]
    tried = [trial for trial in trials if trial.verdict]
    result = Table(title=f'{len(found)} of {len(tried)} faults found')
    for column in ('', 'place', 'kind', 'change', 'round', 'test', 's'):
        result.add_column(column)
    for trial in trials:
        fault = trial.fault
        found_by = trial.test + (' (time limit)' if trial.timed_out else '')
        change = f'{fault.old.splitlines()[0]} -> {fault.new.strip()}'
        result.add_row(
            str(trial.number),
            f'{fault.path}:{fault.line}',
            fault.kind,
            change,
            trial.round if trial.verdict == FOUND else trial.verdict,
            found_by,
            f'{trial.seconds:.0f}',
        )
    return result
