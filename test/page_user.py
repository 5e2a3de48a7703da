"""A person at the page: `trainer view` as a process, where things are on it, what colours say."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

import numpy as np

from bench.page.browser import Page

ROOT = Path(__file__).resolve().parents[1]
REACHED_M = 0.003
"""[m] beside a place where the blade is over it."""
YIELDED_M, YIELDED_S = 0.006, 2.0
"""[m] beside the end of a stroke, and [s], where the tissue holds the hand back: 1.5 N by 4 mm."""


def sessions() -> set[Path]:
    """All bags where the page records."""
    return set((ROOT / 'bags' / 'sessions').glob('*'))


class View:
    """`trainer view` as a process of its own; `with` ends it, and prints what it said."""

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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        print(self.said)
        if self.process.poll() is None:
            self.end()

    def url(self, whose: str = 'page') -> str:
        """Where the page is, or that of the `instructor`, once all nodes are ready."""
        deadline = time.monotonic() + 240
        while self._said.read_text().count(' is ready') < 5:
            assert self.process.poll() is None and time.monotonic() < deadline, self.said
            time.sleep(0.1)
        pattern = rf'^{whose}: (http://127\.0\.0\.1:\d+/\w*\?token=\S+)$'
        found = re.search(pattern, self.said, re.MULTILINE)
        assert found, self.said
        return found[1]

    @property
    def said(self) -> str:
        return self._said.read_text()

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


def point(page: Page, place: np.ndarray) -> None:
    """Lets the blade come over a place of the tissue [m].

    The mouse moves again where a machine that stood still has lost a motion.
    """
    for _ in range(10):
        start(page)
        page.wait(lambda: page.state()['canGuide'], 'the hand')
        x, y = page.pixels(place[None])[0]
        for beside in (6.0, 3.0, 0.0):
            page.mouse('mouseMoved', x + beside, y)
            time.sleep(0.1)
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            time.sleep(0.2)
            if off(page, place) < REACHED_M:
                time.sleep(0.5)
                return
    raise AssertionError(page.state())


def off(page: Page, place: np.ndarray) -> float:
    """How far the tip is beside a place, in the plane [m]."""
    tip = np.array(page.state()['moment']['tip'])
    return float(np.linalg.norm((tip - place)[:2]))


def cut(page: Page, places: np.ndarray, notches: int = 0) -> None:
    """Cuts through places of the surface, the button held until the blade is at the last one.

    Args:
        page: to use.
        places: [m], shape (n, 3); one: presses there.
        notches: of the wheel, each 0.5 mm deeper than 6 mm.
    """
    point(page, places[0])
    pixels = page.pixels(places)
    page.mouse('mousePressed', *pixels[0], pressed=True)
    x, y = pixels[0]
    for _ in range(notches):
        page.call('Input.dispatchMouseEvent', type='mouseWheel', x=x, y=y, deltaX=0, deltaY=120)
    time.sleep(1.5)
    for pixel in pixels[1:]:
        page.mouse('mouseMoved', *pixel, pressed=True)
        time.sleep(0.1)
    near: list[float] = []  # since when

    def ended() -> bool:
        beside = off(page, places[-1])
        if beside >= YIELDED_M:
            near.clear()
        elif not near:
            near.append(time.monotonic())
        return beside < REACHED_M or (bool(near) and time.monotonic() - near[0] > YIELDED_S)

    page.wait(ended, 'the end of the stroke')
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
