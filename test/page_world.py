"""A session that is none, behind the real server of pages: what the tests of the client look at.

Run `python test/page_world.py [--replay] [--port 8080]` to look at the page without a graph.
"""

import argparse
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from bench.page.browser import Browser, Page
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.assembly import make_simulation
from cutting_trainer.viewer import plots
from cutting_trainer.viewer.access_control import Gate, link
from cutting_trainer.viewer.allowed_requests import LiveControls, ReplayControls
from cutting_trainer.viewer.appearance import (
    FLOOR,
    OTHER_TISSUE,
    camera,
    reach,
    shown_exercise,
    shown_tissue,
    tool_shape,
)
from cutting_trainer.viewer.drawn_surface import CUT, TissueSource
from cutting_trainer.viewer.live_page import OWN_TISSUE
from cutting_trainer.viewer.page_protocol import (
    AnyMessage,
    Guide,
    Hold,
    Record,
    Scale,
    SetTissue,
    Watch,
)
from cutting_trainer.viewer.page_server import PageServer

TOKEN, INSTRUCTOR = 'stand-in', 'stand-in-instructor'
PERIOD = 1 / 30
SPEED = 0.3
"""[m/s] of the hand."""
DOWN = 0.7071067811865476
WATCH = """window.broken = [];
document.addEventListener('securitypolicyviolation', e => window.broken.push(e.blockedURI));
window.addEventListener('error', e => window.broken.push(e.message));"""
ATTEMPTS: list[dict[str, Any]] = [
    {
        'bag': f'circle-{number}',
        'subject': 'p-01',
        'exercise': 'circle',
        'attempt': number,
        'begun': 1.7e9 + number,
        'state': state,
        'points': points,
        'passed': points is not None and points > 70,
    }
    for number, state, points in (
        (3, 'broken off', None), (2, 'scored', 91.25), (1, 'scored', 40.0),
    )
]  # fmt: skip


class StandIn:
    """Serves a page, follows what is asked for, and remembers it.

    Args:
        scene: of the tissue.
        mode: live or replay.
        port: to serve at; 0: a free one.
        slope: of the tissue along x.
        says: what nodes and session say, by type.
    """

    def __init__(
        self,
        scene: str = 'liver',
        mode: Any = 'live',
        port: int = 0,
        slope: float = 0.0,
        **says: dict[str, Any],
    ) -> None:
        self.asked: list[AnyMessage] = []
        self._scene = load_scene(scene)
        simulation = make_simulation(self._scene.tissue)[0]
        mesh = simulation.mesh
        positions = np.array(simulation.positions)
        self._top, self._slope = float(positions[:, 2].max()), slope
        positions[:, 2] += slope * positions[:, 0]
        self.positions = positions
        self._tissue = SimpleNamespace(
            rest=positions,
            displacement=np.zeros_like(positions),
            triangles=mesh.triangles.copy(),
            triangle_kind=mesh.triangle_kind.copy(),
            revision=0,
        )
        self._open_a_cut()
        self.tip = np.array([*positions.mean(axis=0)[:2], positions[:, 2].max() + 0.02])
        self.goal = self.tip.copy()
        self.wxyz = [1.0, 0.0, 0.0, 0.0]
        self.state, self.e_stopped, self.recording = 'DISABLED', False, ''
        self.held, self.tissue = False, dict(OWN_TISSUE)
        self.clutched = False
        self._mode, self._says = mode, says
        self._controls: Any = LiveControls(
            scenes=('block', scene),
            methods=('combined', 'delete'),
            scale=(0.1, 3.0),
            bounds=reach(positions),
            session=True,
            exercises={'circle': 'Precision cutting'},
            bags=tuple(row['bag'] for row in ATTEMPTS),
        )
        if mode == 'replay':
            self._controls = ReplayControls(20.0, (0.25, 1.0, 4.0))
        gate = Gate(frozenset({'127.0.0.1', 'localhost'}), TOKEN, INSTRUCTOR)
        self.server = PageServer('127.0.0.1', port, gate, mode, self._controls, self._act)
        self.url = link('127.0.0.1', self.server.port, (), TOKEN)
        self.instructor = link('127.0.0.1', self.server.port, (), INSTRUCTOR, 'instructor')
        self._sources = [TissueSource('tissue'), TissueSource('computed')]
        self._ends = threading.Event()
        self.stands_still = threading.Event()
        self.loses_goals = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.greet()
        self._thread.start()

    def stop(self) -> None:
        """Ends the session and the server."""
        self._ends.set()
        self._thread.join()
        self.server.stop()

    close = stop

    def move(self, along: float) -> None:
        """Moves the whole tissue along y [m]."""
        self._tissue.displacement[:, 1] = along
        self._tissue.revision += 1

    def on_top(self, x: float, y: float) -> np.ndarray:
        """A place on the upper side of the tissue [m]."""
        return np.array([x, y, self._top + self._slope * x])

    def of(self, kind: type) -> list[Any]:
        """What was asked for, of one kind."""
        return [message for message in self.asked if isinstance(message, kind)]

    def wait(self, condition: Callable[[], Any]) -> Any:
        """Waits until a condition holds."""
        deadline = time.monotonic() + 30
        while not (value := condition()):
            assert time.monotonic() < deadline, self.asked
            time.sleep(0.02)
        return value

    def _open_a_cut(self) -> None:
        """Says of a strip of the upper side that a cut has opened it."""
        middle = self.positions[self._tissue.triangles].mean(axis=1)
        centre = middle.mean(axis=0)
        x, y, z = (middle - centre).T
        strip = (np.abs(y + 0.2 * x) < 0.0016) & (np.abs(x) < 0.02) & (z > 0)
        self._tissue.triangle_kind[strip] = CUT

    def greet(self, **changed: Any) -> None:
        """Sends the first message of a session, with changes."""
        live = self._mode == 'live'
        tissues = [shown_tissue('tissue', '' if live else 'recorded')]
        seen = self.positions
        if not live:
            apart = 1.25 * float(np.ptp(seen[:, 0]))
            tissues.append(shown_tissue('computed', 'tougher', OTHER_TISSUE, apart))
            seen = np.concatenate([seen, seen + np.array([apart, 0.0, 0.0])])
        bounds = reach(self.positions)
        content = {
            'version': 1,
            'mode': self._mode,
            'title': 'Cutting trainer' if live else 'Recorded session',
            'session': live,
            'scenes': ['block', 'liver'],
            'methods': ['combined', 'delete'],
            'duration': None if live else 20.0,
            'speeds': [] if live else [0.25, 1.0, 4.0],
            'exercises': [{'name': 'circle', 'title': 'Precision cutting'}] if live else [],
            'tool': tool_shape(self._scene.tool),
            'further_tools': [],
            'camera': camera(seen),
            'floor': FLOOR,
            'bounds': {'low': bounds.low, 'high': bounds.high} if live else None,
            'metres_per_newton': 0.02,
            'tissues': tissues,
            'plots_span': 15.0 if live else 20.0,
            'exercise': shown_exercise(self._scene.exercise),
        }
        self.server.put('hello', **(content | self._says.get('hello', {}) | changed))

    def _act(self, message: AnyMessage) -> None:
        self.asked.append(message)
        word = message.op
        if word == 'e_stop':
            self.state, self.e_stopped = 'FAULT', True
        elif word == 'reset_e_stop':
            self.e_stopped = False
        elif word in ('start', 'pause'):
            self.state = 'ENABLED' if word == 'start' else 'PAUSED'
        elif isinstance(message, Hold):
            self.held, self.state = message.on, 'PAUSED' if message.on else 'ENABLED'
        elif isinstance(message, SetTissue):
            self.tissue = {'stiffness': message.stiffness, 'toughness': message.toughness}
        elif isinstance(message, Guide):
            if not self.loses_goals:
                self.goal, self.wxyz = np.array(message.position), list(message.wxyz)
        elif isinstance(message, Record):
            self.recording = '2026-01-01_12-00-00_liver' if message.on else ''
        elif isinstance(message, Scale):
            self.server.put('scale', value=message.value, min=0.1, max=3.0)
        elif isinstance(message, Watch):
            self.server.put('replay', number=message.number, link=f'{self.url}&replay')
        elif word == 'play':
            self._playing = message.on  # type: ignore[union-attr]
        elif word == 'seek':
            self._time = message.time  # type: ignore[union-attr]

    def _run(self) -> None:
        self._playing, self._time, began = False, 12.5, time.monotonic()
        self.server.put('scale', value=1.0, min=0.1, max=3.0)
        while not self._ends.wait(PERIOD):
            if self.stands_still.is_set():
                continue
            self.server.tick()
            self._tick(time.monotonic() - began)

    def _tick(self, now: float) -> None:
        way = self.goal - self.tip
        length = float(np.linalg.norm(way))
        self.tip = self.tip + way * min(1.0, SPEED * PERIOD / max(length, 1e-9))
        top = float(self.on_top(*self.tip[:2])[2])
        depth = max(0.0, top - float(self.tip[2]))
        self._bend(depth)
        if self._mode == 'live':
            self._show_session(now, depth)
        else:
            self._time = min(20.0, self._time + PERIOD * self._playing)
            self.server.put('playhead', time=self._time, playing=self._playing, speed=1.0)
        force = [0.0, 0.0, 40.0 * depth] if self.state == 'ENABLED' else [0.0, 0.0, 0.0]
        self.server.put(
            'moment',
            tip=self.tip.tolist(),
            wxyz=self.wxyz,
            proxy=[*self.tip[:2].tolist(), max(float(self.tip[2]), top)],
            force=force,
            depth=depth,
            can_guide=self.state == 'ENABLED',
            contact=int(depth > 0),
            clutched=self.clutched,
            further=[],
        )
        for source in self._sources[: 1 if self._mode == 'live' else 2]:
            if (frame := source.frame(self._tissue)) is not None:
                self.server.put_tissue(frame)
        self._plot(now, depth)

    def _bend(self, depth: float) -> None:
        beside = np.linalg.norm(self.positions[:, :2] - self.tip[:2], axis=1)
        dent = 0.8 * depth * np.exp(-((beside / 0.012) ** 2))
        if np.abs(self._tissue.displacement[:, 2] + dent).max() > 1e-6:
            self._tissue.displacement[:, 2] = -dent
            self._tissue.revision += 1

    def _show_session(self, _: float, depth: float) -> None:
        text = {'ENABLED': 'Force is on.', 'FAULT': 'emergency stop. No force until Start.'}
        changed = replace(
            self._controls,
            can_guide=self.state == 'ENABLED',
            e_stopped=self.e_stopped,
            recording=bool(self.recording),
            held=self.held,
        )
        if changed != self._controls:
            self._controls = changed
            self.server.allow(changed)
        show: dict[str, dict[str, Any]] = {
            'state': {
                'state': self.state,
                'text': text.get(self.state, 'No force. Start enables it.'),
                'guided': '',
                'e_stopped': self.e_stopped,
                'held': self.held,
            },
            'attempts': {'rows': ATTEMPTS},
            'session': {
                'scene': 'liver',
                'method': 'combined',
                'recording': self.recording,
                'busy': '',
                'scenes': ['block', 'liver'],
                'tissue': self.tissue,
            },
            'nodes': {
                'rows': [
                    {'name': 'arm', 'level': 0, 'message': 'emulated', 'rate': 1000.0},
                    {'name': 'cutting', 'level': 0, 'message': 'waits for strokes', 'rate': 0.0},
                    {
                        'name': 'haptic_bridge',
                        'level': 2 if self.e_stopped else 0,
                        'message': 'emergency stop' if self.e_stopped else 'force on',
                        'rate': 1000.0,
                    },
                    {'name': 'recorder', 'level': 3, 'message': 'silent for 4 s', 'rate': 0.0},
                    {'name': 'tissue', 'level': 1, 'message': 'catches up', 'rate': 29.6},
                ]
            },
        }
        for kind, content in show.items():
            self.server.put(kind, **(content | self._says.get(kind, {})))

    def _plot(self, now: float, _: float) -> None:
        if self._mode == 'live':
            times = np.linspace(-15, 0, 150)
            moving, span = times + now, [-15.0, 0.0]
        else:
            times = moving = np.linspace(0, 20, 1000)
            span = [0.0, 20.0]
        force = np.clip(0.6 * np.sin(moving) * np.sin(0.37 * moving), 0, None)
        lines = [
            plots.FORCE.lines(times, force),
            plots.DEPTH.lines(times, 18 * force**0.7),
            plots.RATES.lines(times, 100 + np.sin(9 * moving), 98 + 3 * np.sin(5 * moving)),
        ]
        self.server.put('plots', span=span, lines=lines)


@contextmanager
def opened(browser: Browser, stand_in: StandIn) -> Iterator[Page]:
    """A page on a session, with its picture."""
    with closing(stand_in):
        page = browser.page()
        page.call('Page.addScriptToEvaluateOnNewDocument', source=WATCH)
        page.open(stand_in.url)
        page.wait(lambda: page.state().get('tip') and page.state()['meshes'], 'the page')
        yield page
        assert page.evaluate('window.broken') == []
        page.open('about:blank')


def guided(page: Page) -> np.ndarray:
    """Lets the force in; where the blade is in the window then [pixel]."""
    page.press('start')
    page.wait(lambda: page.state()['canGuide'], 'the hand')
    return np.array(page.state()['tip'])


def key(page: Page, code: str, name: str) -> None:
    for kind in ('keyDown', 'keyUp'):
        page.call('Input.dispatchKeyEvent', type=kind, code=code, key=name)


def main() -> None:
    """Serves until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--replay', action='store_true')
    parser.add_argument('--port', type=int, default=8080)
    given = parser.parse_args()
    page = StandIn('liver', 'replay' if given.replay else 'live', given.port)
    print(page.url, flush=True)
    threading.Event().wait()


if __name__ == '__main__':
    main()
