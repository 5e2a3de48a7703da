"""Trainees with a mouse: the strokes of a good and of a bad attempt at an exercise."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from page_user import cut, point, start

from bench.page.browser import Page
from cutting_trainer.session.scene_loader import load_scene

TIMEOUT_S = 240.0
SETTLED_S = 2.0
HEIGHT_MM, TIP_MM = 4, 4
"""Height of the blade's end over the surface without a cut, and of the tip over that."""
_STEP_S = 0.1
_MAX_BRIDGES = 5
_BEFORE_M, _BEHIND_M = 0.002, 0.006
"""[m] of a stroke before and behind tissue that still holds a lesion."""


@dataclass(frozen=True)
class Exercise:
    """How a mouse does an exercise.

    Attributes:
        good, bad: strokes, each a line of places on the surface [m], shape (n, 3).
        reason: that the bad attempt fails for.
        notches: of the wheel, each 0.5 mm deeper than 6 mm.
        leaves: distance from the middle at which the tool is lifted at the end, over that of the
            end; there the tissue is whole.
    """

    good: Sequence[np.ndarray]
    bad: Sequence[np.ndarray]
    reason: str
    notches: int = 0
    leaves: float = 1.0


def line(*corners: tuple[float, float, float], count: int = 12) -> np.ndarray:
    """Places along a straight line [m]."""
    return np.linspace(*np.array(corners), count)


def presses(*places: tuple[float, float]) -> list[np.ndarray]:
    """Strokes that stay at a place of the block of the lumps [m]."""
    return [np.array([[x, y, 0.024]]) for x, y in places]


def ring(radii: tuple[float, float], height: float, turns: float, count: int = 48) -> np.ndarray:
    """Places along an ellipse around the middle, at a height [m]."""
    angles = 2 * np.pi * np.linspace(0.0, turns, count)
    x, y = radii
    return np.column_stack([x * np.cos(angles), y * np.sin(angles), np.full(count, height)])


OPENED, MARKED = 'target that is opened', 'lumps marked'
EXERCISES = {
    'lumps': Exercise(
        presses((-0.015, -0.012), (0.018, -0.003), (-0.006, 0.018)),
        presses((0.018, -0.003), (0.012, 0.018)),
        MARKED,
    ),
    'vessel': Exercise(
        [line((-0.017, 0, 0.014), (0.020, 0, 0.014))],
        [line((-0.017, 0, 0.014), (-0.002, 0, 0.014))],
        OPENED,
        notches=4,
    ),
    'pad': Exercise(
        [line((-0.018, 0, 0.014), (0.0285, 0, 0.014))],
        [line((-0.018, 0, 0.014), (0, 0, 0.014))],
        OPENED,
    ),
    'circle': Exercise(
        [ring((0.02625, 0.02625), 0.004, 1.05)],
        [ring((0.02625, 0.02625), 0.004, 0.5)],
        OPENED,
    ),
    'excision': Exercise(
        [ring((0.01696, 0.01144), 0.004, 1.05)],
        [ring((0.01696, 0.01144), 0.004, 0.5)],
        OPENED,
        leaves=1.25,
    ),
}  # fmt: skip


def attempt(page: Page, exercise: str, skill: str, subject: str) -> str:
    """Does an exercise; the score and its reasons, as the page says them."""
    page.evaluate(f"document.querySelector('#exercise').value = '{exercise}'")
    page.evaluate(f"document.querySelector('#subject').value = '{subject}'")
    page.press('begin')
    page.wait(lambda: page.state()['recording'].startswith(exercise), 'the recording', TIMEOUT_S)
    page.wait(lambda: not page.state()['busy'] and page.state()['moments'], 'the nodes', TIMEOUT_S)
    time.sleep(SETTLED_S)
    start(page)
    how = EXERCISES[exercise]
    for number, stroke in enumerate(getattr(how, skill)):
        cut(page, stroke, how.notches if number == 0 else 0)
        page.mouse('mouseReleased', *page.pixels(stroke[-1:])[0])
        time.sleep(SETTLED_S)
    if skill == 'good':
        _sever(page, how.good[0])
    _return(page, exercise)
    said = "document.querySelector('#task-score:not([hidden])')?.innerText"
    return str(page.wait(lambda: page.evaluate(said), 'the score', TIMEOUT_S))


def _sever(page: Page, border: np.ndarray) -> None:
    """Cuts what still holds the lesion, by the page: along the border, to and fro."""
    for number in range(_MAX_BRIDGES):
        if (bridge := page.state()['bridge']) is None:
            return
        place = np.array([*bridge[:2], border[0, 2]])
        nearest = int(np.linalg.norm(border[:-1] - place, axis=1).argmin())
        along = border[nearest + 1] - border[nearest]
        along *= (-1) ** number / np.linalg.norm(along)
        cut(page, line(place - _BEFORE_M * along, place + _BEHIND_M * along))
        page.mouse('mouseReleased', *page.pixels(place[None])[0])
        time.sleep(SETTLED_S)


def _return(page: Page, exercise: str) -> None:
    """Lifts the tool at the place of the end."""
    end = load_scene(exercise).exercise.end
    assert end is not None
    where = np.array(end.centre)
    surface = EXERCISES[exercise].good[0][0, 2]
    point(page, np.array([*EXERCISES[exercise].leaves * where[:2], surface]))
    for _ in range(round(1e3 * (where[2] - surface)) - HEIGHT_MM - TIP_MM):
        page.evaluate("document.querySelector('[data-guide=up]').click()")
        time.sleep(_STEP_S)
