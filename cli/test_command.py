"""The checks of the test command: lint, format, tests."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cutting_trainer.session.errors import SessionError

Tier = Literal['quick', 'usual', 'all']
"""Which tests are run; test/conftest.py says what each leaves out."""
TESTS, LIVE, ALONE = 'tests', 'tests two at a time', 'tests one at a time'
MAX_REPETITIONS = 3
"""Further runs, one at a time, of those live tests that failed. They have deadlines, and a shared
machine may stand still for seconds; each says what it measured."""
TESTS_FAILED, NO_TESTS = 1, 5
"""Exit statuses of pytest: some test failed; there was none."""


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        name: shown to the user.
        argv: its command.
        repetitions: largest number of further runs of the tests that failed.
    """

    name: str
    argv: tuple[str, ...]
    repetitions: int = 0


def require_checkout(folder: Path) -> None:
    """Refuse to check an installation, which has no tests and lies among packages of others.

    Raises:
        SessionError: the folder is no checkout of the source.
    """
    if not ((folder / 'pyproject.toml').is_file() and (folder / 'test').is_dir()):
        raise SessionError(
            f'the trainer is installed in {folder}, without its tests: '
            'run ./trainer test in a checkout of its source'
        )


def all_checks(pytest_arguments: Sequence[str], temporary: Path, tier: Tier) -> list[Check]:
    """Return the checks of a tier, in the order in which they are run.

    Each part of the tests remembers by itself which tests failed, for `--last-failed`.

    Args:
        pytest_arguments: for all parts of the tests: those that may run beside others, on every
            processor; those with a graph, two at a time, as they mostly wait; and those that want
            the machine for themselves.
        temporary: folder for the files of all: the last tests look at what all have made.
        tier: the quick one has only tests of the first part.
    """
    # A test that ends its process ends its part of the tests. A new process would run that test
    # first; one that waits for ever would end one process after the other.
    python, by_file = (sys.executable, '-m'), ('--dist=loadfile', '--max-worker-restart=0')
    checks = [
        Check('ruff check', (*python, 'ruff', 'check', '.')),
        Check('ruff format', (*python, 'ruff', 'format', '--check', '.')),
    ]
    for name, part, more, repetitions in (
        (TESTS, 'beside', ('--numprocesses=auto', *by_file, '--no-loadscope-reorder'), 0),
        (LIVE, 'live', ('--numprocesses=2', *by_file), MAX_REPETITIONS),
        (ALONE, 'alone', (), MAX_REPETITIONS),
    ):
        which = (f'--tier={tier}', f'--part={part}', '--last-failed-no-failures=none')
        where = (f'--basetemp={temporary / part}', '-o', f'cache_dir=.pytest_cache/{part}')
        argv = (*python, 'pytest', *which, *where, *more, *pytest_arguments)
        checks.append(Check(name, argv, repetitions))
    return [check for check in checks if tier != 'quick' or check.name not in (LIVE, ALONE)]


def run_checks(
    checks: Sequence[Check], folder: Path, announce: Callable[[str], None]
) -> dict[str, int]:
    """Run all checks, also after one has failed.

    A test that has passed in a repetition has passed: a process of its own has run it then, with
    fixtures of its own.

    Args:
        checks: what to run.
        folder: where to run it.
        announce: is given the name of each check before it runs.

    Returns:
        exit status by name.
    """
    results = {}
    for check in checks:
        announce(check.name)
        status = subprocess.run(check.argv, cwd=folder, check=False).returncode
        for number in range(1, check.repetitions + 1):
            if status != TESTS_FAILED:
                break
            announce(f'{check.name}: those that failed, again ({number} of {check.repetitions})')
            status = subprocess.run(again(check, number), cwd=folder, check=False).returncode
            status = TESTS_FAILED if status == NO_TESTS else status
        results[check.name] = status
    return results


def again(check: Check, number: int) -> list[str]:
    """Return the command of a check for the tests that failed, with a folder of its own."""
    argv = [f'{a}-{number}' if a.startswith('--basetemp=') else a for a in check.argv]
    return [*argv, '--last-failed', '--numprocesses=0']


def verdict(results: dict[str, int]) -> tuple[int, str]:
    """Return exit status of the first check that failed, 0 if none did, and a sentence that names
    all.

    Arguments may choose tests of some parts only; of none is a failure.
    """
    parts = [name for name in (TESTS, LIVE, ALONE) if name in results]
    empty = [name for name in parts if results[name] == NO_TESTS]
    if len(empty) < len(parts):
        results = {name: status for name, status in results.items() if name not in empty}
    failed = {name: status for name, status in results.items() if status}
    if not failed:
        return 0, f'all passed: {", ".join(results)}'
    status = next(iter(failed.values()))
    return (status if status > 0 else 1), f'failed: {", ".join(failed)}'
