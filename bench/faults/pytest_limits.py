"""Plugin of pytest for runs that only ask whether a test fails.

It ends the process where one test takes too much CPU time: the default action of a signal also
ends a loop in a compiled kernel, to which no Python handler comes. Hypothesis shrinks no example.
"""

import signal
from collections.abc import Iterator

import pytest
from hypothesis import Phase, settings

MAX_CPU_S = 180.0
"""[s] for one test, of which compiling takes most."""


@pytest.hookimpl(trylast=True)
def pytest_configure() -> None:
    """Take shrinking out of the profile that the tests have chosen."""
    phases = (Phase.explicit, Phase.reuse, Phase.generate)
    settings.register_profile('first failure', settings.default, phases=phases)
    settings.load_profile('first failure')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[None]:
    """Start the process's clock anew for each test."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, MAX_CPU_S)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
