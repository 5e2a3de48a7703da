"""A headless Chromium, driven by its DevTools protocol in the role of a person.

Pictures are drawn by software, so that no graphics card is needed.
"""

import base64
import io
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import numpy as np
from matplotlib import image
from websockets.sync.client import connect

from bench.common.waiting import until
from cutting_trainer.session import parent_death_signal

STEP_TIMEOUT_S = 150.0
"""Timeout of any step on a shared machine without a graphics card."""
_NAMES = ('chromium', 'chromium-browser', 'google-chrome')
CHROMIUM = next(filter(None, map(shutil.which, _NAMES)), None)


class Page:
    """One page that is open in the browser.

    Args:
        address: of its DevTools socket.
        coarseness: pixels of the page for one that is drawn, along each side.
    """

    def __init__(self, address: str, coarseness: int = 1) -> None:
        self._coarseness = coarseness
        self._socket = connect(address, max_size=None)
        self._numbers = itertools.count(1)
        self.requests: list[str] = []
        self.call('Page.enable')
        self.call('Network.enable')

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            message = json.loads(self._socket.recv(STEP_TIMEOUT_S))
            if message.get('method') == 'Network.requestWillBeSent':
                self.requests.append(message['params']['request']['url'])
            if message.get('id') == number:
                assert 'error' not in message, message
                return message['result']

    def resize(self, width: int, height: int) -> None:
        """Give the page another size [pixel]."""
        self.call(
            'Emulation.setDeviceMetricsOverride',
            width=width,
            height=height,
            deviceScaleFactor=1 / self._coarseness,
            mobile=False,
        )

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call('Page.navigate', url=url)

    def reload(self) -> None:
        """Load the page again, without a copy of the old one in the back."""
        self.call('Page.reload')

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        done = self.call('Runtime.evaluate', expression=script, returnByValue=True)
        return done['result'].get('value')

    def picture(self) -> np.ndarray:
        """Return a screenshot, shape (height, width, 3), 0 to 255."""
        data = base64.b64decode(self.call('Page.captureScreenshot', format='png')['data'])
        drawn = np.rint(255 * image.imread(io.BytesIO(data))[..., :3]).astype(np.uint8)
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

    def close(self) -> None:
        """Leave the page to the browser."""
        self._socket.close()


class Browser:
    """A browser that runs.

    Args:
        port: of the DevTools.
        size: of its pages [pixel].
        coarseness: pixels of the page for one that is drawn, along each side.
        process: number of its first process.
    """

    def __init__(self, port: int, size: tuple[int, int], coarseness: int, process: int) -> None:
        self._port, self._size, self._coarseness = port, size, coarseness
        self.process = process
        self.pages: list[Page] = []

    def page(self, url: str = 'about:blank') -> Page:
        """Open one more page."""
        request = Request(f'http://127.0.0.1:{self._port}/json/new?about:blank', method='PUT')
        with urlopen(request) as answer:
            page = Page(json.load(answer)['webSocketDebuggerUrl'], self._coarseness)
        page.resize(*self._size)
        page.open(url)
        self.pages.append(page)
        return page


@contextmanager
def chromium(size: tuple[int, int], coarseness: int = 1) -> Iterator[Browser]:
    """Run a browser with a temporary profile that reaches this machine only.

    Args:
        size: of its pages [pixel].
        coarseness: pixels of a page for one that is drawn: software draws slowly.
    """
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(prefix='chromium-', ignore_cleanup_errors=True) as profile:
        # Bound to this process: the kernel ends both together.
        command = [sys.executable, '-I', '-S', parent_death_signal.__file__, str(os.getpid()), '9']
        command += [CHROMIUM, '--headless=new', '--no-sandbox', '--remote-debugging-port=0']
        command += [f'--user-data-dir={profile}', '--no-first-run', '--disable-extensions']
        command += ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--mute-audio']
        command += ['--disable-background-networking', '--disable-dev-shm-usage']
        command += ['--disable-features=BackForwardCache']
        command += ['--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1']
        with Path(profile, 'said').open('wb') as said:
            process = subprocess.Popen(
                command,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        try:
            file = Path(profile, 'DevToolsActivePort')
            deadline = time.monotonic() + STEP_TIMEOUT_S
            while not (file.exists() and file.read_text().count('\n')):
                assert process.poll() is None, Path(profile, 'said').read_text()
                assert time.monotonic() < deadline, 'chromium does not start'
                time.sleep(0.05)
            port = int(file.read_text().splitlines()[0])
            browser = Browser(port, size, coarseness, process.pid)
            yield browser
            for page in browser.pages:
                page.close()
        finally:
            os.killpg(process.pid, 9)
            process.wait()
