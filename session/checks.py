"""The checks of the test command: lint, format, types, tests."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from session.errors import SessionError

TESTS, ALONE = 'tests', 'tests one at a time'
NO_TESTS = 5
"""Exit status of pytest where it has found none."""


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        name: what the user sees.
        argv: its command.
    """

    name: str
    argv: tuple[str, ...]


def require_checkout(folder: Path) -> None:
    """Refuses to check an installation, which has no tests and lies among packages of others.

    Raises:
        SessionError: the folder is no checkout of the source.
    """
    if not ((folder / 'pyproject.toml').is_file() and (folder / 'test').is_dir()):
        raise SessionError(
            f'the trainer is installed in {folder}, without its tests: '
            'run ./trainer test in a checkout of its source'
        )


def all_checks(pytest_arguments: Sequence[str], temporary: Path) -> list[Check]:
    """Every check, in the order in which it is run; mypy's folders stand in pyproject.toml.

    Args:
        pytest_arguments: for both parts of the tests: those that may run beside others, on every
            processor, and those that want the machine for themselves.
        temporary: folder for the files of both: the last tests look at what all have made.
    """
    python = (sys.executable, '-m')
    tests = (*python, 'pytest', *pytest_arguments)
    return [
        Check('ruff check', (*python, 'ruff', 'check', '.')),
        Check('ruff format', (*python, 'ruff', 'format', '--check', '.')),
        Check('mypy', (*python, 'mypy')),
        *(
            Check(name, (*tests, f'--part={part}', f'--basetemp={temporary / part}', *more))
            for name, part, more in (
                (TESTS, 'beside', ('--numprocesses=auto', '--dist=loadfile')),
                (ALONE, 'alone', ()),
            )
        ),
    ]


def run_checks(
    checks: Sequence[Check], folder: Path, announce: Callable[[str], None]
) -> dict[str, int]:
    """Runs all checks, whatever becomes of each, so that one run tells everything.

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
        results[check.name] = subprocess.run(check.argv, cwd=folder, check=False).returncode
    return results


def verdict(results: dict[str, int]) -> tuple[int, str]:
    """Exit status of the first check that failed, 0 if none did, and a sentence that names all.

    Arguments may choose tests of one part only; of none is a failure.
    """
    empty = [name for name in (TESTS, ALONE) if results.get(name) == NO_TESTS]
    if len(empty) == 1:
        results = {name: status for name, status in results.items() if name not in empty}
    failed = {name: status for name, status in results.items() if status}
    if not failed:
        return 0, f'all passed: {", ".join(results)}'
    status = next(iter(failed.values()))
    return (status if status > 0 else 1), f'failed: {", ".join(failed)}'
