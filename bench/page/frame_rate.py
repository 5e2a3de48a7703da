"""Frame rate of the page while a recorded session plays, drawn by software, and its processor time.

Run `python -m bench.page.frame_rate BAG [--scene liver] [--seconds 10] [--size 1280x800]`: prints
pictures, updates of the tissue and of the tool a second, the processor time of browser and server
as a share of a core, and the load of the machine.
"""

import argparse
import json
import os
import time
from pathlib import Path
from threading import Thread

from bench.page.browser import Browser, chromium
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.session.node_commands import LOCAL
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.viewer.access_control import link, make_gate
from cutting_trainer.viewer.recording import Recording
from cutting_trainer.viewer.replay_page import ReplayPage

_MAX_PLAYED_S = 60.0
"""[s] that a session may play."""


def processor_time(root: int) -> float:
    """Return the processor time of a process and all below it [s]."""
    parents, times = {}, {}
    for stat in Path('/proc').glob('[0-9]*/stat'):
        try:
            words = stat.read_text().rpartition(')')[2].split()
        except OSError:  # it has ended meanwhile
            continue
        process = int(stat.parent.name)
        parents[process], times[process] = int(words[1]), int(words[11]) + int(words[12])
    total, around = 0, [root]
    while around:
        one = around.pop()
        total += times.get(one, 0)
        around += [process for process, parent in parents.items() if parent == one]
    return total / float(os.sysconf('SC_CLK_TCK'))


def measure(browser: Browser, url: str, seconds: float) -> dict[str, float]:
    """Return rates [Hz] and shares of a core while the session of a page plays.

    Args:
        browser: that draws.
        url: of a page of a recorded session.
        seconds: to play.
    """
    page = browser.page(url)
    page.wait(lambda: page.state().get('meshes') and page.state()['frames'], 'the page')
    page.press('play')
    page.wait(lambda: page.state()['playhead']['playing'], 'the session')
    before, drawn = page.state(), processor_time(browser.process)
    served, began = time.process_time(), time.monotonic()
    time.sleep(seconds)
    after, took = page.state(), time.monotonic() - began
    drawn, served = processor_time(browser.process) - drawn, time.process_time() - served
    names = {'frames': 'pictures', 'meshes': 'tissue', 'moments': 'tool'}
    rates = {name: (after[key] - before[key]) / took for key, name in names.items()}
    return rates | {'browser': drawn / took, 'server': served / took}


def main() -> None:
    """Play a bag in the browser, and print the measurement as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('bag', type=Path)
    parser.add_argument('--scene', default='liver')
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--at', type=float, default=0.0, help='where the session begins [s]')
    parser.add_argument('--size', default='1280x800')
    given = parser.parse_args()
    bag, scene = open_bag(given.bag), load_scene(given.scene)
    gate = make_gate(LOCAL, [])
    recording = Recording(bag, scene.tool, scene.device, scene.exercise)
    page = ReplayPage(recording, None, LOCAL, 0, gate)
    page.seek(given.at)
    ended: list[bool] = []
    Thread(target=page.run, args=(lambda: bool(ended),), daemon=True).start()
    width, height = map(int, given.size.split('x'))
    load = os.getloadavg()[0]
    with chromium((width, height)) as browser:
        url = link(LOCAL, page.server.port, [], gate.token)
        found = measure(browser, url, min(given.seconds, _MAX_PLAYED_S))
    ended.append(True)
    page.server.stop()
    shown = {name: round(value, 2) for name, value in found.items()}
    print(json.dumps(shown | {'load_before': load, 'size': given.size}))


if __name__ == '__main__':
    main()
