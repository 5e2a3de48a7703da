"""Latency from a motion of the mouse to the picture of the hand that has begun to follow it.

Run `python -m bench.page.latency URL [--moves 30]` with the link of `./trainer view`, which must be
free to move: it presses Start. The pose that is drawn is the measured one of the graph. Prints
median and largest of the milliseconds between the browser's mouse event and the first picture with
a tool that has moved by 0.3 mm, the round trip of the goal through hand, bridge and viewer
included, and the load of the machine.
"""

import argparse
import json
import os
import statistics
import time

import numpy as np

from bench.page.browser import Page, chromium

_MOVED_M = 0.0003
_STEP_PX = 30.0
_SETTLE_S = 0.6
_WATCH = f"""window.delays = [];
document.querySelector('#view').addEventListener('pointermove', () => {{
    const began = performance.now(), from = window.page.state.moment.tip;
    const look = () => {{
        const now = window.page.state.moment.tip;
        if (Math.hypot(...now.map((x, i) => x - from[i])) > {_MOVED_M}) {{
            requestAnimationFrame(() => window.delays.push(performance.now() - began));
        }} else if (performance.now() - began < 1000) requestAnimationFrame(look);
    }};
    look();
}}, {{capture: true}});"""


def delays(page: Page, moves: int) -> list[float]:
    """Return the delay of each motion over the tissue [ms].

    Args:
        page: of a live session whose hand can be guided.
        moves: how many; those after which nothing moved within 1 s are left out.
    """
    tip = np.array(page.state()['moment']['tip'])
    place = page.pixels(np.array([[0.0, 0.0, 0.5 * tip[2]]]))[0]
    page.mouse('mouseMoved', *place)
    time.sleep(2 * _SETTLE_S)
    page.evaluate(_WATCH)
    for number in range(moves):
        page.mouse('mouseMoved', place[0] + _STEP_PX * (number % 2), place[1])
        time.sleep(_SETTLE_S)
    return list(page.evaluate('window.delays'))


def main() -> None:
    """Measure a session that runs, and print the latency as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('url')
    parser.add_argument('--moves', type=int, default=30)
    given = parser.parse_args()
    load = os.getloadavg()[0]
    with chromium((1280, 800)) as browser:
        page = browser.page(given.url)
        page.wait(lambda: page.state().get('moment') and page.state()['meshes'], 'the page')
        page.press('start')
        page.wait(lambda: page.state()['canGuide'], 'the hand')
        found = delays(page, given.moves)
    shown = {'moves': len(found), 'median_ms': round(statistics.median(found), 1)}
    print(json.dumps(shown | {'largest_ms': round(max(found), 1), 'load_before': load}))


if __name__ == '__main__':
    main()
