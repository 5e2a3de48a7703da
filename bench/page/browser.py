"""A headless Chromium in the role of a person."""

import io
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import image

from bench.common.waiting import until
from cutting_trainer.recordings import headless_browser
from cutting_trainer.recordings.headless_browser import CHROMIUM as CHROMIUM
from cutting_trainer.recordings.headless_browser import STEP_TIMEOUT_S, run_browser

LOADED = """[...performance.getEntriesByType('navigation'),
    ...performance.getEntriesByType('resource')].map(entry => entry.name)"""


class Page(headless_browser.Page):
    """One page that a person looks at and operates."""

    def reload(self) -> None:
        """Load the page again, without a copy of the old one in the back."""
        self.call('Page.reload')

    def requests(self) -> list[str]:
        """Return the addresses of all that the page has loaded since it was opened."""
        return self.evaluate(LOADED)

    def picture(self) -> np.ndarray:
        """Return a screenshot, shape (height, width, 3), 0 to 255."""
        drawn = np.rint(255 * image.imread(io.BytesIO(self.screenshot()))[..., :3]).astype(np.uint8)
        return drawn.repeat(self._coarseness, axis=0).repeat(self._coarseness, axis=1)

    def save(self, file: Path) -> None:
        """Write a screenshot as PNG."""
        image.imsave(file, self.picture())

    def mouse(self, kind: str, x: float, y: float, *, pressed: bool = False) -> None:
        """Send one event of the mouse at a place [pixel]."""
        self.call(
            'Input.dispatchMouseEvent',
            type=kind,
            x=x,
            y=y,
            button='left' if pressed or kind != 'mouseMoved' else 'none',
            buttons=int(pressed),
            clickCount=int(kind != 'mouseMoved'),
        )

    def drag(self, points: np.ndarray, step: float = 0.03) -> None:
        """Press at the first place [pixel], move through the others, and release at the last."""
        self.mouse('mouseMoved', *points[0])
        time.sleep(10 * step)
        self.mouse('mousePressed', *points[0], pressed=True)
        for point in points[1:]:
            time.sleep(step)
            self.mouse('mouseMoved', *point, pressed=True)
        time.sleep(10 * step)
        self.mouse('mouseReleased', *points[-1])

    def click(self, text: str) -> None:
        """Click the button with this text."""
        self._click('button:enabled', f'e.innerText.trim() === {json.dumps(text)}')

    def press(self, name: str) -> None:
        """Click the enabled control of an id."""
        self._click(f'#{name}:enabled', 'true')

    def choose(self, name: str, wanted: str) -> None:
        """Choose an entry of the list of an id by its text; its popup cannot be clicked."""
        script = f"""(() => {{
            const list = document.querySelector('#{name}:enabled');
            const one = [...list?.options ?? []].find(o => o.text === {json.dumps(wanted)});
            if (!one) return false;
            list.value = one.value;
            list.dispatchEvent(new Event('change', {{bubbles: true}}));
            return true;
        }})()"""
        self.wait(lambda: self.evaluate(script), f'{wanted} in the list {name}')

    def slide(self, name: str, share: float) -> None:
        """Click on the slider of an id, at a share of its length."""
        self._click(f'input#{name}:enabled', 'true', share)

    def state(self) -> Any:
        """Return the state of the page, as it reports it; empty before it is loaded."""
        return self.evaluate('window.page?.state') or {}

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return where points of the tissue frame are in the window [pixel], shape (n, 2)."""
        rows = np.asarray(points, float).tolist()
        found = self.evaluate(f'{json.dumps(rows)}.map(point => window.page.project(point))')
        return np.array(found, float)

    def _click(self, kind: str, condition: str, share: float = 0.5) -> None:
        """Click on the first element `e` of a kind that fulfils a condition, both as scripts."""
        script = f"""(() => {{
            const one = [...document.querySelectorAll('{kind}')].find(e => {condition});
            if (!one) return null;
            one.scrollIntoView({{block: 'nearest'}});
            const r = one.getBoundingClientRect();
            return r.width ? [r.x + {share} * r.width, r.y + r.height / 2] : null;
        }})()"""
        place = self.wait(lambda: self.evaluate(script), f'{kind} where {condition}')
        self.mouse('mouseMoved', *place)
        self.mouse('mousePressed', *place, pressed=True)
        self.mouse('mouseReleased', *place)

    def says(self, text: str) -> bool:
        """Return whether the page shows a text."""
        return text in (self.evaluate('document.body.innerText') or '')

    def wait(self, condition: Callable[[], Any], goal: str, timeout: float = STEP_TIMEOUT_S) -> Any:
        """Wait for a condition, and return its value."""
        return until(condition, goal, timeout, 0.1)


Browser = headless_browser.Browser[Page]


@contextmanager
def chromium(size: tuple[int, int], coarseness: int = 1) -> Iterator[Browser]:
    """Run a browser; see `run_browser`."""
    with run_browser(Page, size, coarseness) as browser:
        yield browser
