"""Processes that another one has begun, by Linux's `/proc`."""

from pathlib import Path


def children_of(process: int) -> list[int]:
    """Return the running child processes of a process."""
    threads = Path(f'/proc/{process}/task').glob('*/children')
    return [int(child) for thread in threads for child in thread.read_text().split()]
