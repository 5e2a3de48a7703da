"""Claims about the node of the page: what pages ask for becomes topics, services, and lines."""

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from cutting_trainer_msgs.msg import Mesh
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Bool, Empty
from std_srvs.srv import Trigger

from bench.page.open_page import OpenPage
from bench.page.stand_in import sheet
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.qos import EVENTS, LATCHED
from cutting_trainer.node_common.ros import (
    ARM,
    DIAGNOSTICS,
    FRAME,
    HAND,
    MESH,
    RESET_TISSUE,
    Diagnostics,
)
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.node_commands import (
    BRIDGE_NODE,
    LOCAL,
    node_environment,
    viewer_command,
)
from cutting_trainer.session.node_process import parse_message
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.streaming.messages import packed
from cutting_trainer.viewer.access_control import INSTRUCTOR_VARIABLE, TOKEN_VARIABLE
from cutting_trainer.viewer.diagnostics_table import name_within

pytestmark = pytest.mark.long

TOKEN, INSTRUCTOR = 'of-this-test', 'of-its-instructor'
TOKENS = {TOKEN_VARIABLE: TOKEN, INSTRUCTOR_VARIABLE: INSTRUCTOR}
MAX_LINE = 4096
"""Characters that a line for the launcher may have."""


class Graph:
    """What the viewer meets: a bridge that holds an E-STOP, an arm that follows, a tissue."""

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = node = rclpy.create_node('graph', context=self.context)
        self.stops = self.resets = self.tissues = 0
        self.words: list[str] = []
        self.goals: list[Any] = []
        types = crtk_types()
        self._state = types.operating_state
        self._states = node.create_publisher(
            types.operating_state, f'{BRIDGE_NODE}/operating_state', LATCHED
        )
        self._stopped = node.create_publisher(Bool, f'{BRIDGE_NODE}/e_stopped', LATCHED)
        self._status = node.create_publisher(DiagnosticArray, DIAGNOSTICS, EVENTS)
        self._mesh = node.create_publisher(Mesh, MESH, LATCHED)
        node.create_subscription(Empty, f'{BRIDGE_NODE}/e_stop', self._stop, EVENTS)
        for name in (BRIDGE_NODE, ARM):
            node.create_subscription(types.command, f'{name}/state_command', self._command, EVENTS)
        node.create_subscription(PoseStamped, HAND, self.goals.append, EVENTS)
        node.create_service(Trigger, f'{BRIDGE_NODE}/reset_e_stop', self._reset)
        node.create_service(Trigger, RESET_TISSUE, self._reset_tissue)
        node.create_timer(0.5, self._speak)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        self._show_mesh()
        self.enter('ENABLED')

    def enter(self, state: str) -> None:
        self._states.publish(self._state(state=state))

    def _show_mesh(self) -> None:
        tissue = sheet()
        count = len(tissue.triangles)
        mesh = Mesh(scene='sheet', revision=0, rest=packed('d', tissue.rest))
        mesh.displacement = packed('d', tissue.displacement)
        mesh.fixed = packed('B', np.zeros(len(tissue.rest)))
        mesh.triangles, mesh.triangle_kind = packed('I', tissue.triangles), packed('B', count * [0])
        mesh.header.frame_id = FRAME
        mesh.header.stamp = self.node.get_clock().now().to_msg()
        self._mesh.publish(mesh)

    def _speak(self) -> None:
        status = DiagnosticStatus(name=BRIDGE_NODE, message='all is well', level=b'\0')
        self._status.publish(DiagnosticArray(status=[status]))

    def _stop(self, _: Any) -> None:
        self.stops += 1
        self._stopped.publish(Bool(data=True))
        self.enter('FAULT')

    def _reset(self, _: Any, response: Any) -> Any:
        self.resets += 1
        self._stopped.publish(Bool(data=False))
        self.enter('DISABLED')
        response.success = True
        return response

    def _reset_tissue(self, _: Any, response: Any) -> Any:
        self.tissues += 1
        response.message = 'The mesh is gone.'
        return response

    def _command(self, message: Any) -> None:
        self.words.append(message.string)
        if message.string == 'enable':
            self.enter('ENABLED')

    def end(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        rclpy.shutdown(context=self.context)


class Viewer:
    """The node as the launcher runs it, with all its lines."""

    def __init__(self, domain: int) -> None:
        command = viewer_command(load_scene('block').path, LOCAL, 0, session=True)
        self.process = subprocess.Popen(
            command.argv,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | node_environment(domain) | TOKENS,
        )
        self.lines: list[str] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(line.rstrip('\n') for line in iter(self.process.stdout.readline, ''))

    @property
    def asked(self) -> list[dict[str, Any]]:
        found = [line.partition(': ')[2] for line in self.lines if line.startswith('message: ')]
        return [parse_message(text) or {} for text in found]

    def answer(self, **content: Any) -> None:
        state = {'scene': 'block', 'method': 'combined', **content}
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(state) + '\n')
        self.process.stdin.flush()


@pytest.fixture(scope='module')
def everything() -> Iterator[tuple[Graph, Viewer, OpenPage]]:
    with reserved_domain('free') as domain:
        os.environ.update(node_environment(domain))
        graph, viewer = Graph(domain), Viewer(domain)
        try:
            deadline = time.monotonic() + 120
            while not (viewer.asked and 'page' in viewer.asked[0]):
                assert viewer.process.poll() is None and time.monotonic() < deadline, viewer.lines
                time.sleep(0.05)
            page = OpenPage(viewer.asked[0]['page'])
            viewer.answer()
            page.wait(lambda: page.newest is not None, 'the tissue')
            known = {'session', 'state', 'controls', 'scale'}
            page.wait(lambda: known <= page.values.keys(), 'the session')
            yield graph, viewer, page
            page.close()
        finally:
            viewer.process.send_signal(signal.SIGINT)
            assert viewer.process.wait(30) == 0, viewer.lines[-20:]
            graph.end()


def allowed(page: OpenPage, op: str) -> bool:
    return (
        op
        not in page.values.get('controls', {'refused': {'trainee': {op: ''}}})['refused']['trainee']
    )


def test_link_has_the_token_of_the_launcher(everything: Any) -> None:
    _, viewer, page = everything
    assert viewer.asked[0]['page'].endswith(f'/?token={TOKEN}')
    assert viewer.asked[0]['instructor'].endswith(f'/instructor?token={INSTRUCTOR}')
    assert page.values['hello']['camera'] is not None
    assert {'block', 'liver'} <= set(page.values['hello']['scenes'])


def test_e_stop_is_a_topic_of_its_own_and_holds_until_its_reset(everything: Any) -> None:
    graph, _, page = everything
    before, words = graph.stops, len(graph.words)
    page.ask('e_stop')
    page.wait(lambda: graph.stops > before, 'the stop')
    page.wait(lambda: 'disable' in graph.words[words:], 'the word to the arm')
    page.wait(lambda: page.values['state']['e_stopped'], 'the stop on the page')
    page.wait(lambda: not allowed(page, 'start'), 'the control')
    words = len(graph.words)
    page.ask('start')
    page.wait(lambda: page.values.get('refused', {}).get('op') == 'start', 'the refusal')
    page.ask('reset_e_stop')
    page.wait(lambda: graph.resets, 'the reset')
    page.wait(lambda: not page.values['state']['e_stopped'], 'the reset on the page')
    assert 'enable' not in graph.words[words:]  # neither did: no force without Start
    page.wait(lambda: allowed(page, 'start'), 'the control')
    page.ask('start')
    page.wait(lambda: 'enable' in graph.words[words:], 'the start')


def test_the_instructors_pause_holds_against_every_start_until_its_end(everything: Any) -> None:
    graph, viewer, page = everything
    instructor = OpenPage(viewer.asked[0]['instructor'])
    graph.enter('ENABLED')
    page.wait(lambda: page.values['state']['state'] == 'ENABLED', 'the force')
    words = len(graph.words)
    instructor.ask('hold', on=True)
    page.ask('start')  # in the moment, before its page knows
    page.wait(lambda: page.values['state']['held'], 'the pause')
    assert 'The instructor has paused' in page.values['controls']['refused']['trainee']['start']
    graph.enter('PAUSED')
    page.wait(lambda: page.values['state']['text'].startswith('The instructor'), 'the reason')
    page.ask('start')
    page.ask('e_stop')
    page.wait(lambda: page.values['state']['e_stopped'], 'the stop')
    page.ask('reset_e_stop')
    page.wait(lambda: not page.values['state']['e_stopped'], 'the reset')
    page.ask('start')
    page.wait(lambda: page.values.get('refused', {}).get('op') == 'start', 'the refusal')
    assert page.values['state']['held'] and 'pause' in graph.words[words:]
    assert not {'enable', 'resume'} & set(graph.words[words:])
    instructor.ask('hold', on=False)
    page.wait(lambda: 'enable' in graph.words[words:], 'the force again')
    page.wait(lambda: not page.values['state']['held'], 'the end of the pause')
    instructor.close()


def test_the_tissue_of_the_instructor_is_a_line_for_the_launcher(everything: Any) -> None:
    _, viewer, page = everything
    instructor = OpenPage(viewer.asked[0]['instructor'])
    instructor.wait(lambda: 'session' in instructor.values, 'the session')
    tissue = {'stiffness': 1.5, 'toughness': 0.5}
    assert instructor.values['session']['tissue'] == {'stiffness': 1.0, 'toughness': 1.0}
    instructor.ask('tissue', **tissue)
    page.wait(lambda: viewer.asked[-1] == {'ask': 'restart', 'tissue': tissue}, 'the line')
    viewer.answer(tissue=tissue)
    instructor.wait(lambda: instructor.values['session']['tissue'] == tissue, 'the answer')
    instructor.close()


def test_hand_is_guided_around_the_tissue_while_the_force_is_on(everything: Any) -> None:
    graph, _, page = everything
    turn = [1.0, 0.0, 0.0, 0.0]
    graph.enter('ENABLED')
    page.wait(lambda: allowed(page, 'guide'), 'the control')
    page.ask('guide', position=[0.01, 0.02, 0.03], wxyz=turn)
    page.wait(lambda: graph.goals, 'the goal')
    goal = graph.goals[-1].pose
    assert (goal.position.x, goal.position.z, goal.orientation.w) == (0.01, 0.03, 1.0)
    count = len(graph.goals)
    page.ask('guide', position=[5.0, 0.0, 0.0], wxyz=turn)
    graph.enter('DISABLED')
    page.wait(lambda: not allowed(page, 'guide'), 'the control')
    page.ask('guide', position=[0.01, 0.02, 0.03], wxyz=turn)
    page.ask('ping', id=len(graph.goals))
    page.wait(lambda: page.values.get('pong', {}).get('id') == count, 'the answer')
    time.sleep(0.2)
    assert len(graph.goals) == count
    graph.enter('ENABLED')


def test_reset_takes_the_force_away_and_asks_for_the_tissue_or_with_a_bag_the_launcher(
    everything: Any,
) -> None:
    graph, viewer, page = everything
    words = len(graph.words)
    page.ask('reset')
    page.wait(lambda: graph.tissues, 'the reset')
    page.wait(lambda: 'pause' in graph.words[words:], 'the pause')
    page.wait(lambda: 'gone' in page.values.get('notice', {}).get('text', ''), 'the reason')
    viewer.answer(recording='a bag')
    page.wait(lambda: page.values['session']['recording'], 'the bag')
    page.ask('reset')
    page.wait(lambda: viewer.asked[-1] == {'ask': 'restart'}, 'the line')
    assert graph.tissues == 1
    viewer.answer()
    graph.enter('ENABLED')
    page.wait(lambda: not page.values['session']['recording'], 'the end of the bag')


def test_launcher_is_asked_for_what_is_on_offer_and_in_short_lines(everything: Any) -> None:
    _, viewer, page = everything
    page.wait(lambda: allowed(page, 'choose'), 'the control')
    hostile = OpenPage(viewer.asked[0]['page'])
    hostile.send(json.dumps({'op': 'choose', 'scene': 'x' * 200_000, 'method': 'delete'}))
    hostile.wait(lambda: hostile.closed, 'its end')
    hostile.close()
    page.ask('choose', scene='../../../etc/passwd', method='delete')
    page.wait(lambda: page.values.get('refused', {}).get('op') == 'choose', 'the refusal')
    page.ask('choose', scene='liver', method='delete')
    page.ask('record', on=True)
    wanted = [
        {'ask': 'restart', 'scene': 'liver', 'method': 'delete'},
        {'ask': 'record', 'on': True},
    ]
    page.wait(lambda: viewer.asked[-2:] == wanted, 'the lines')
    assert max(map(len, viewer.lines)) < MAX_LINE
    viewer.answer(busy='The nodes start again ...')
    page.wait(lambda: not allowed(page, 'reset'), 'the control')
    viewer.answer(problem='This could not be done: the terminal says why.')
    page.wait(lambda: 'terminal' in page.values.get('notice', {}).get('text', ''), 'the notice')
    page.wait(lambda: allowed(page, 'reset'), 'the control')


def test_force_scale_that_nobody_takes_stays(everything: Any) -> None:
    _, _, page = everything
    before = page.values['scale']['value']
    count = page.values.get('notice', {}).get('id', 0)
    page.ask('scale', value=2.0)
    page.wait(lambda: page.values.get('notice', {}).get('id', 0) > count, 'the notice')
    assert page.values['scale']['value'] == before


def test_two_trainers_side_by_side_tell_their_nodes_apart_by_namespace() -> None:
    published: list[Any] = []
    for namespace in ('', 'left', 'right'):
        node: Any = SimpleNamespace(
            get_fully_qualified_name=lambda n=namespace: f'/{n}/bridge'.replace('//', '/'),
            create_publisher=lambda *_: SimpleNamespace(publish=published.append),
            create_timer=lambda *_, **__: None,
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time)),
        )
        Diagnostics(node, lambda: (b'\0', '', {})).publish()
    names = [array.status[0].name for array in published]
    assert names == ['bridge', 'left/bridge', 'right/bridge']
    assert [name_within('', name) for name in names] == names
    assert [name_within('left', name) for name in names] == ['', 'bridge', '']
