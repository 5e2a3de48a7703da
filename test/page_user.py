"""A person at the page: `trainer view` as a process, where things are on it, what colours say."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from bench.browser import Page
from viewer.stage import FIELD_OF_VIEW, framing

ROOT = Path(__file__).resolve().parents[1]
GRIP = 0.028
"""[m] from the tip to where the arrows of the handles are gripped."""
UP, RIGHT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def sessions() -> set[Path]:
    """All bags where the page records."""
    return set((ROOT / 'bags' / 'sessions').glob('*'))


class View:
    """`trainer view` as a process of its own."""

    def __init__(self, folder: Path, scene: Path) -> None:
        self._said = folder / 'said'
        command = [sys.executable, '-m', 'session.cli', 'view', '--port', '0']
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
        found = re.search(r'page: (http://127\.0\.0\.1:\d+)$', self.said, re.MULTILINE)
        assert found, self.said
        return found[1]

    @property
    def said(self) -> str:
        return self._said.read_text()

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


class Eye:
    """Where points of the tissue frame are on the page, for its first camera."""

    def __init__(self, page: Page, positions: np.ndarray) -> None:
        position, aim = framing(positions)
        forward = (aim - position) / np.linalg.norm(aim - position)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._position = position
        self._axes = np.stack([right, np.cross(right, forward), forward])
        box = "document.querySelector('canvas').getBoundingClientRect()"
        found = page.evaluate(f'(r => JSON.stringify([r.x, r.y, r.width, r.height]))({box})')
        self.box = np.array(json.loads(found))

    def pixels(self, points: np.ndarray) -> np.ndarray:
        x, y, depth = self._axes @ (np.asarray(points) - self._position).T
        scale = self.box[3] / 2 / np.tan(FIELD_OF_VIEW / 2)
        middle = self.box[:2] + self.box[2:] / 2
        return middle + scale * np.stack([x / depth, -y / depth], axis=1)


def way(start: np.ndarray, axis: np.ndarray, length: float) -> np.ndarray:
    """Places from a grip on the arrow along an axis to `length` further [m], shape (n, 3)."""
    shares = np.concatenate([[0.0, 0.02], np.linspace(0.1, 1.0, 8)])
    return start + np.outer(GRIP + shares * length, axis)


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
        if not page.says('Force is on'):
            page.click('Start')
        deadline = time.monotonic() + 3.0
        while time.monotonic() < deadline:
            if page.says('Force is on'):
                return
            time.sleep(0.1)
    raise AssertionError(page.evaluate('document.body.innerText'))
