"""The picture of the page in README.md and docs/view.md, taken by a headless Chromium from a bag.

Run `python -m bench.view_picture BAG [--at SECONDS] [-o FILE]`.
"""

import argparse
import time
from pathlib import Path
from threading import Thread

from bags.player import duration
from bags.reader import open_bag
from bench.browser import NO_CARD, chromium
from session.scene import load_scene
from viewer.page import addresses
from viewer.replay_page import ReplayPage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('bag', type=Path)
    parser.add_argument('--scene', default='liver')
    parser.add_argument('--at', type=float)
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/images/view.png'))
    given = parser.parse_args()
    bag, scene = open_bag(given.bag), load_scene(given.scene)
    page = ReplayPage(bag, scene.tool, scene.device, None, '', '127.0.0.1', 0)
    page.seek(duration(bag) if given.at is None else given.at)
    ended: list[bool] = []
    Thread(target=page.run, args=(lambda: bool(ended),), daemon=True).start()
    with chromium((1280, 760)) as browser:
        shown = browser.page(addresses(page.server))
        shown.wait(lambda: shown.says('Play'), 'the page')
        shown.evaluate(NO_CARD)
        time.sleep(15.0)
        shown.save(given.output)
    ended.append(True)
    page.server.stop()


if __name__ == '__main__':
    main()
