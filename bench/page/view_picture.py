"""The picture of the page in docs/view.md, taken by a headless Chromium from a bag.

Run `python -m bench.page.view_picture BAG [--at SECONDS] [-o FILE]`.
"""

import argparse
import time
from pathlib import Path
from threading import Thread

from bench.page.browser import chromium
from cutting_trainer.bags.playback_messages import duration
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.session.node_commands import LOCAL
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.viewer.access_control import link, make_gate
from cutting_trainer.viewer.recording import Recording
from cutting_trainer.viewer.replay_page import ReplayPage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('bag', type=Path)
    parser.add_argument('--scene', default='liver')
    parser.add_argument('--at', type=float)
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/images/view.png'))
    given = parser.parse_args()
    bag, scene = open_bag(given.bag), load_scene(given.scene)
    gate = make_gate(LOCAL, [])
    recording = Recording(bag, scene.tool, scene.device, scene.exercise)
    page = ReplayPage(recording, None, LOCAL, 0, gate)
    page.seek(duration(bag) if given.at is None else given.at)
    ended: list[bool] = []
    Thread(target=page.run, args=(lambda: bool(ended),), daemon=True).start()
    with chromium((1280, 760)) as browser:
        shown = browser.page(link(LOCAL, page.server.port, [], gate.token) + '&quality=high')
        shown.wait(lambda: shown.state().get('meshes') and shown.state()['frames'], 'the page')
        time.sleep(3.0)
        shown.save(given.output)
    ended.append(True)
    page.server.stop()


if __name__ == '__main__':
    main()
