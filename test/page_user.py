"""A person at the page: `trainer view` as a process, where things are on it, what colours say."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from bench.page.browser import Page

ROOT = Path(__file__).resolve().parents[1]


def sessions() -> set[Path]:
    """All bags where the page records."""
    return set((ROOT / 'bags' / 'sessions').glob('*'))


class View:
    """`trainer view` as a process of its own."""

    def __init__(self, folder: Path, scene: Path) -> None:
        self._said = folder / 'said'
        command = [sys.executable, '-m', 'cutting_trainer.cli', 'view', '--port', '0']
        with self._said.open('wb') as file:
            self.process = subprocess.Popen(
                [*command, '--scene', str(scene), '--domain', 'free'],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | {'COLUMNS': '200'},
                start_new_session=True,
            )

    def url(self) -> str:
        """Where the page is, once all nodes are ready."""
        deadline = time.monotonic() + 120
        while self._said.read_text().count(' is ready') < 5:
            assert self.process.poll() is None and time.monotonic() < deadline, self.said
            time.sleep(0.1)
        found = re.search(r'page: (http://127\.0\.0\.1:\d+/\?token=\S+)$', self.said, re.MULTILINE)
        assert found, self.said
        return found[1]

    @property
    def said(self) -> str:
        return self._said.read_text()

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


def point(page: Page, place: np.ndarray) -> None:
    """Lets the blade come over a place of the tissue [m]."""
    start(page)
    page.wait(lambda: page.state()['canGuide'], 'the hand')
    x, y = page.pixels(place[None])[0]
    for beside in (6.0, 3.0, 0.0):
        page.mouse('mouseMoved', x + beside, y)
        time.sleep(0.1)
    time.sleep(1.0)


def cut(page: Page, begin: np.ndarray, end: np.ndarray, notches: int = 0) -> None:
    """Cuts from one place of the surface to another [m], the button held.

    Args:
        page: to use.
        begin: of the cut.
        end: of it.
        notches: of the wheel, each 0.5 mm deeper than 6 mm.
    """
    point(page, begin)
    places = page.pixels(np.linspace(begin, end, 12))
    page.mouse('mousePressed', *places[0], pressed=True)
    x, y = places[0]
    for _ in range(notches):
        page.call('Input.dispatchMouseEvent', type='mouseWheel', x=x, y=y, deltaX=0, deltaY=120)
    time.sleep(1.0)
    for place in places[1:]:
        page.mouse('mouseMoved', *place, pressed=True)
        time.sleep(0.1)
    time.sleep(0.7)


def reddish(picture: np.ndarray) -> np.ndarray:
    """Which pixels have the colour of tissue."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r > g + 25) & (r > b + 25) & (abs(g - b) < 60)


def cut_coloured(picture: np.ndarray) -> np.ndarray:
    """Which pixels have the colour of what a cut has opened."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (r > 3 * g) & (r > 2 * b) & (r > 40)


def start(page: Page) -> None:
    """Lets the force in; again where a machine that stood still has made a fault."""
    for _ in range(10):
        if page.state()['state'] != 'ENABLED':
            page.press('start')
        deadline = time.monotonic() + 3.0
        while time.monotonic() < deadline:
            if page.state()['state'] == 'ENABLED':
                return
            time.sleep(0.1)
    raise AssertionError(page.state())
