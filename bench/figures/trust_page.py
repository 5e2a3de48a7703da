"""Figures of the page's gate: leaks after raw messages, and E-STOP during a flood."""

import statistics

from bench.figures.figure import Figure
from bench.page.fuzz_socket import Flood, stop_delays, trial
from bench.page.open_page import OpenPage
from bench.page.stand_in import OtherProcess

LINE = 5
MESSAGES = 12_000
"""Messages to a server without rate limits, so that each reaches the protocol."""
SEED = 17
CLICKS, PAUSE_S = 30, 0.01
FLOODING = 3
GROWTH_MB = 20.0
MAX_TIME_RATIO = 50.0
"""Largest ratio of the time of a click during a flood to one without: about 30 ms."""


def measure() -> list[Figure]:
    """Measure on a real server with stand-in actions, while two more pages are open."""
    outcome = trial(MESSAGES, SEED, limited=False)
    sent, tried = outcome.messages, outcome.tried
    working, started = outcome.working / tried, outcome.processes + outcome.connections
    after = f'after {sent} raw messages'
    return [
        Figure(LINE, f'controls that work {after}', working, 1.0, 'at least', '', tried),
        Figure(LINE, f'memory that grew {after}', outcome.memory, GROWTH_MB, 'at most', 'MB', sent),
        Figure(LINE, f'processes and connections {after}', started, 0, 'at most', '', sent),
        _stop_beside_flood(),
    ]


def _stop_beside_flood() -> Figure:
    with OtherProcess(limited=True) as server:
        page = OpenPage(server.url)
        quiet = statistics.median(stop_delays(server, page, CLICKS, PAUSE_S))
        with Flood(server.url, FLOODING):
            flooded = statistics.median(stop_delays(server, page, CLICKS, PAUSE_S))
        page.close()
    return Figure(
        line=LINE,
        name=f'E-STOP of a page while {FLOODING} others flood, median',
        value=flooded / quiet,
        bound=MAX_TIME_RATIO,
        side='at most',
        unit='',
        samples=CLICKS,
        reference='the same without a flood',
        absolute=f'{1e3 * flooded:.2f} ms after {1e3 * quiet:.2f} ms',
    )
