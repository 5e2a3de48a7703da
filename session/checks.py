"""The checks of the test command: lint, format, types, tests."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from session.errors import SessionError


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


def all_checks(pytest_arguments: Sequence[str]) -> list[Check]:
    """Every check, in the order in which it is run; mypy's folders stand in pyproject.toml."""
    python = (sys.executable, '-m')
    return [
        Check('ruff check', (*python, 'ruff', 'check', '.')),
        Check('ruff format', (*python, 'ruff', 'format', '--check', '.')),
        Check('mypy', (*python, 'mypy')),
        Check('pytest', (*python, 'pytest', *pytest_arguments)),
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
    """Exit status of the first check that failed, 0 if none did, and a sentence that names all."""
    failed = {name: status for name, status in results.items() if status}
    if not failed:
        return 0, f'all passed: {", ".join(results)}'
    status = next(iter(failed.values()))
    return (status if status > 0 else 1), f'failed: {", ".join(failed)}'
