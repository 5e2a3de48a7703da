"""A headless Chromium, driven by its DevTools protocol: what a person does with mouse and eyes.

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

from session import child

PATIENCE = 150.0
"""[s] that a shared machine without a graphics card may need for anything."""
_NAMES = ('chromium', 'chromium-browser', 'google-chrome')
CHROMIUM = next(filter(None, map(shutil.which, _NAMES)), None)
NO_CARD = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
"""Script that closes the page's note that there is no graphics card."""


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
        """Calls a method of the protocol and returns its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            message = json.loads(self._socket.recv(PATIENCE))
            if message.get('method') == 'Network.requestWillBeSent':
                self.requests.append(message['params']['request']['url'])
            if message.get('id') == number:
                assert 'error' not in message, message
                return message['result']

    def resize(self, width: int, height: int) -> None:
        """Gives the page another size [pixel]."""
        self.call(
            'Emulation.setDeviceMetricsOverride',
            width=width,
            height=height,
            deviceScaleFactor=1 / self._coarseness,
            mobile=False,
        )

    def open(self, url: str) -> None:
        """Goes to a page."""
        self.call('Page.navigate', url=url)

    def reload(self) -> None:
        """Loads the page again, without a copy of the old one in the back."""
        self.call('Page.reload')

    def evaluate(self, script: str) -> Any:
        """The value of an expression in the page."""
        done = self.call('Runtime.evaluate', expression=script, returnByValue=True)
        return done['result'].get('value')

    def picture(self) -> np.ndarray:
        """What is seen, shape (height, width, 3), 0 to 255."""
        data = base64.b64decode(self.call('Page.captureScreenshot', format='png')['data'])
        drawn = np.rint(255 * image.imread(io.BytesIO(data))[..., :3]).astype(np.uint8)
        return drawn.repeat(self._coarseness, axis=0).repeat(self._coarseness, axis=1)

    def save(self, file: Path) -> None:
        """Writes what is seen as PNG."""
        image.imsave(file, self.picture())

    def mouse(self, kind: str, x: float, y: float, *, pressed: bool = False) -> None:
        """One event of the mouse at a place [pixel]."""
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
        """Presses at the first place [pixel], moves through the others, and lets go at the last."""
        self.mouse('mouseMoved', *points[0])
        time.sleep(10 * step)
        self.mouse('mousePressed', *points[0], pressed=True)
        for point in points[1:]:
            time.sleep(step)
            self.mouse('mouseMoved', *point, pressed=True)
        time.sleep(10 * step)
        self.mouse('mouseReleased', *points[-1])

    def click(self, text: str) -> None:
        """Clicks the button that says this."""
        self._click('button:enabled', f'e.innerText.trim() === {json.dumps(text)}')

    def choose(self, now: str, wanted: str) -> None:
        """Chooses something else where a list shows what is chosen now."""
        self._click('input[role=combobox]:enabled', f'e.value === {json.dumps(now)}')
        said = f'e.innerText.trim() === {json.dumps(wanted)}'
        self._click('[role=option]', f'{said} && e.offsetParent')

    def slide(self, share: float) -> None:
        """Clicks on the first slider, at a share of its length."""
        self._click('.mantine-Slider-root', 'true', share)

    def _click(self, kind: str, condition: str, share: float = 0.5) -> None:
        """Clicks on the first element `e` of a kind that fulfils a condition, both as scripts."""
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
        """Whether the page shows a text."""
        return text in (self.evaluate('document.body.innerText') or '')

    def wait(self, condition: Callable[[], Any], what: str, patience: float = PATIENCE) -> Any:
        """Waits for a condition to be true, and returns it."""
        deadline = time.monotonic() + patience
        while not (value := condition()):
            assert time.monotonic() < deadline, f'waited in vain for {what}'
            time.sleep(0.1)
        return value

    def close(self) -> None:
        """Leaves the page to the browser."""
        self._socket.close()


class Browser:
    """A browser that runs.

    Args:
        port: of the DevTools.
        size: of its pages [pixel].
        coarseness: pixels of the page for one that is drawn, along each side.
    """

    def __init__(self, port: int, size: tuple[int, int], coarseness: int) -> None:
        self._port, self._size, self._coarseness = port, size, coarseness
        self.pages: list[Page] = []

    def page(self, url: str = 'about:blank') -> Page:
        """Opens one more page."""
        request = Request(f'http://127.0.0.1:{self._port}/json/new?about:blank', method='PUT')
        with urlopen(request) as answer:
            page = Page(json.load(answer)['webSocketDebuggerUrl'], self._coarseness)
        page.resize(*self._size)
        page.open(url)
        self.pages.append(page)
        return page


@contextmanager
def chromium(size: tuple[int, int], coarseness: int = 1) -> Iterator[Browser]:
    """A browser with a profile of its own, that reaches this machine only; gone in the end.

    Args:
        size: of its pages [pixel].
        coarseness: pixels of a page for one that is drawn: software draws slowly.
    """
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(prefix='chromium-', ignore_cleanup_errors=True) as profile:
        # Bound to this process, whatever ends it.
        command = [sys.executable, '-I', '-S', child.__file__, str(os.getpid()), '9']
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
            deadline = time.monotonic() + PATIENCE
            while not (file.exists() and file.read_text().count('\n')):
                assert process.poll() is None, Path(profile, 'said').read_text()
                assert time.monotonic() < deadline, 'chromium does not start'
                time.sleep(0.05)
            browser = Browser(int(file.read_text().splitlines()[0]), size, coarseness)
            yield browser
            for page in browser.pages:
                page.close()
        finally:
            os.killpg(process.pid, 9)
            process.wait()
