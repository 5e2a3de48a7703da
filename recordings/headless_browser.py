"""A headless Chromium, driven by its DevTools protocol.

Pictures are drawn by software, so that no graphics card is needed.
"""

import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.request import Request, urlopen

from websockets.sync.client import connect

from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.parent_death_signal import bound

STEP_TIMEOUT_S = 150.0
"""Timeout of any step on a shared machine without a graphics card."""
_CLOSING_TIMEOUT_S = 0.1
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
        # Events that nobody reads would hold up the end of the connection until its timeout.
        self._socket = connect(address, max_size=None, close_timeout=_CLOSING_TIMEOUT_S)
        self._numbers = itertools.count(1)
        self.call('Page.enable')

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol and return its result.

        Raises:
            RuntimeError: the browser refuses it.
        """
        number = next(self._numbers)
        self._socket.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            message = json.loads(self._socket.recv(STEP_TIMEOUT_S))
            if message.get('id') == number:
                if 'error' in message:
                    raise RuntimeError(f'{method}: {message["error"]}')
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

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression in the page; of a promise, once it has one."""
        done = self.call(
            'Runtime.evaluate', expression=script, returnByValue=True, awaitPromise=True
        )
        return done['result'].get('value')

    def screenshot(self, **options: Any) -> bytes:
        """Return a picture of the page, by default as PNG.

        Args:
            options: of `Page.captureScreenshot`.
        """
        data = self.call('Page.captureScreenshot', **{'format': 'png'} | options)['data']
        return base64.b64decode(data)

    def close(self) -> None:
        """Leave the page to the browser."""
        self._socket.close()


P = TypeVar('P', bound=Page)


class Browser(Generic[P]):
    """A browser that runs.

    Args:
        kind: of its pages.
        port: of the DevTools.
        size: of its pages [pixel].
        coarseness: pixels of the page for one that is drawn, along each side.
        process: number of its first process.
    """

    def __init__(
        self, kind: type[P], port: int, size: tuple[int, int], coarseness: int, process: int
    ) -> None:
        self._kind, self._port, self._size, self._coarseness = kind, port, size, coarseness
        self.process = process
        self.pages: list[P] = []

    def page(self, url: str = 'about:blank') -> P:
        """Open one more page."""
        request = Request(f'http://127.0.0.1:{self._port}/json/new?about:blank', method='PUT')
        with urlopen(request) as answer:
            page = self._kind(json.load(answer)['webSocketDebuggerUrl'], self._coarseness)
        page.resize(*self._size)
        page.open(url)
        self.pages.append(page)
        return page


@contextmanager
def run_browser(kind: type[P], size: tuple[int, int], coarseness: int = 1) -> Iterator[Browser[P]]:
    """Run a browser with a temporary profile that reaches this machine only.

    Args:
        kind: of its pages.
        size: of its pages [pixel].
        coarseness: pixels of a page for one that is drawn: software draws slowly.

    Raises:
        SessionError: there is no browser, or it does not start.
    """
    if CHROMIUM is None:
        raise SessionError('chromium is not installed: sudo apt install chromium')
    with tempfile.TemporaryDirectory(prefix='chromium-', ignore_cleanup_errors=True) as profile:
        command = [CHROMIUM, '--headless=new', '--no-sandbox', '--remote-debugging-port=0']
        command += [f'--user-data-dir={profile}', '--no-first-run', '--disable-extensions']
        command += ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--mute-audio']
        command += ['--disable-background-networking', '--disable-dev-shm-usage']
        command += ['--disable-features=BackForwardCache']
        # Software draws letters and plots in half the time without a graphics card between.
        command += ['--disable-accelerated-2d-canvas', '--disable-gpu-rasterization']
        command += ['--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1']
        with Path(profile, 'said').open('wb') as said:
            process = subprocess.Popen(
                bound(signal.SIGKILL, *command),
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        try:
            file = Path(profile, 'DevToolsActivePort')
            deadline = time.monotonic() + STEP_TIMEOUT_S
            while not (file.exists() and file.read_text().count('\n')):
                if process.poll() is not None or time.monotonic() > deadline:
                    said_so = Path(profile, 'said').read_text(errors='replace')[-400:]
                    raise SessionError(f'chromium does not start: {said_so}')
                time.sleep(0.05)
            port = int(file.read_text().splitlines()[0])
            browser = Browser(kind, port, size, coarseness, process.pid)
            yield browser
            for page in browser.pages:
                page.close()
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
