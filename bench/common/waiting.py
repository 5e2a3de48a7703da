"""Waiting for a condition."""

import time
from collections.abc import Callable
from typing import Any


def until(
    condition: Callable[[], Any], goal: str, timeout: float = 20.0, period: float = 0.005
) -> Any:
    """Poll a condition until it is true, and return its value.

    Args:
        condition: to poll.
        goal: name of the condition, for the error.
        timeout: [s].
        period: time between two polls [s].
    """
    deadline = time.monotonic() + timeout
    while not (value := condition()):
        assert time.monotonic() < deadline, f'timeout while waiting for {goal}'
        time.sleep(period)
    return value
