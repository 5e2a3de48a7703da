"""Managed nodes: configure, activate, deactivate, and the process around them.

States and transitions are those of ROS 2's managed nodes (design.ros2.org, "Managed nodes").
"""

import faulthandler
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter

from cutting_trainer.node_common import output
from cutting_trainer.node_common.parameters import max_message_parameter, parameter
from cutting_trainer.node_common.rejections import RejectionStatistics

GC_THRESHOLD = 20_000
"""New objects between two runs of the garbage collector."""
YIELD_S = 0.0005
"""Pause between two callbacks: a flood of messages must leave the interpreter to the loops."""
DEACTIVATE_TIMEOUT_S = 5.0
"""Time for a deactivated node to leave its work."""
_DESTROY_TIMEOUT_S = 3
"""Time for the middleware to leave the graph, once the node's work is done. Fast DDS may deadlock
there (its issue 6502), and no other thread of Python runs meanwhile: SIGALRM ends the process."""
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_OWNED = ('publishers', 'subscriptions', 'clients', 'services', 'timers')


class Stop:
    """A flag that a signal handler may set at any moment; `threading.Event` can deadlock there.

    Args:
        also: a further condition for the end.
    """

    def __init__(self, also: Callable[[], bool] = lambda: False) -> None:
        self._set = False
        self._also = also

    def set(self) -> None:
        """Ask for the end."""
        self._set = True

    def is_set(self) -> bool:
        """Return whether the end is asked for."""
        return self._set or self._also()

    def wait(self) -> None:
        """Return soon after `set`."""
        while not self.is_set():
            time.sleep(0.05)


class ManagedNode(LifecycleNode):
    """A node with the managed life cycle of ROS 2.

    UNCONFIGURED, the node has its parameters. INACTIVE, it has read the scene and made its topics.
    ACTIVE, it works. A subclass implements `configure` and, as needed, `work`, `rest` and
    `release`.

    Parameters:
        autostart: become ACTIVE at once; otherwise a lifecycle manager activates the node.
        max_message: largest accepted message [bytes], meshes aside.

    Attributes:
        rejections: statistics of messages that the node rejected.
        max_message: the parameter.
        problem: why the last configuration failed, or None.
        ended: the node was shut down: its process is to end.
        spin_count: callbacks that its executor has served, for the heartbeat.
    """

    largest_message = 1 << 20
    """Default of `max_message`."""

    def __init__(self, name: str) -> None:
        # rclpy would log a line for every invalid request, without a bound.
        self._callback_group = ReentrantCallbackGroup()
        mute = Parameter('start_type_description_service', value=False)
        super().__init__(name, parameter_overrides=[mute])
        self.rejections = RejectionStatistics()
        self.max_message = max_message_parameter(self, self.largest_message)
        self.problem: Exception | None = None
        self.ended = False
        self.spin_count = 0
        self._rounds = 0
        self._active = False
        self._turn = threading.Lock()
        self._resting = threading.Event()
        self._resting.set()
        self._before: dict[str, list[Any]] = {}
        text = 'become ACTIVE at once; else a lifecycle manager configures and activates the node'
        self.autostart = bool(parameter(self, 'autostart', True, text))

    @property
    def default_callback_group(self) -> CallbackGroup:
        """Reentrant: one thread serves it, and an entity that could not be taken must not block
        others.
        """
        return self._callback_group

    @property
    def is_active(self) -> bool:
        """Whether the node is ACTIVE."""
        return self._active

    def configure(self) -> None:
        """Read parameters and scene, make topics and services.

        Raises:
            ValueError: the configuration is not valid; the node stays UNCONFIGURED.
        """

    def work(self, stop: Stop) -> None:
        """Work in the main thread until `stop` is set; the node is ACTIVE meanwhile."""
        announce_ready(self)
        stop.wait()

    @property
    def progress(self) -> int:
        """Counter that changes while the work goes on: cycles of its loop, or of the executor."""
        return self.spin_count

    @property
    def signs_of_life(self) -> tuple[int, int]:
        """Counters that change unless the node hangs, at work or at rest."""
        return self._rounds, self.progress if self._active else 0

    def rest(self) -> None:
        """Clean up after the work, when the node becomes INACTIVE."""

    def release(self) -> None:
        """Release resources before the entities made by `configure` are destroyed."""

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:  # noqa: N802
        """Reply to each request; rclpy leaves requests without reply if the state does not allow
        them.
        """
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except RCLError:
            response.success = False
            return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._before = {kind: list(getattr(self, kind)) for kind in _OWNED}
        try:
            self.problem = None
            self.configure()
        except Exception as error:
            self.problem = error
            self._destroy()
            if not self.autostart:
                said = str(error) if isinstance(error, ValueError) else repr(error)
                self.get_logger().error(f'not configured: {said}')
            return _FAILURE
        return _SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._active = True
        return _SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        with self._turn:
            self._active = False
        if not self._resting.wait(DEACTIVATE_TIMEOUT_S):
            self.get_logger().error(
                f'still at work {DEACTIVATE_TIMEOUT_S:g} s after it was deactivated'
            )
            faulthandler.dump_traceback()  # to the log: where
            return TransitionCallbackReturn.ERROR
        self.rest()
        return _SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.release()
        self._destroy()
        return _SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        if state.label == 'active':
            self.on_deactivate(state)
        self.ended = True  # and released with its process
        return _SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.ended = True  # whoever watches it starts it again
        return _SUCCESS

    def serve(self, stop: Stop) -> None:
        """Work while the node is ACTIVE; return when it no longer is. Called repeatedly."""
        self._rounds += 1
        with self._turn:
            if self._active:
                self._resting.clear()
        if self._resting.is_set():
            time.sleep(0.02)
            return
        # Objects that live as long as the node are not scanned again, the others less often:
        # the collector took a quarter of the recorder's time.
        gc.freeze()
        gc.set_threshold(GC_THRESHOLD)
        try:
            self.work(Stop(lambda: stop.is_set() or not self._active))
        finally:
            self._resting.set()

    def end(self) -> None:
        """Rest and release, if not done yet."""
        if self._active:
            self._active = False
            self.rest()
        if self._before:
            self.release()

    def destroy_node(self) -> None:
        """Destroy the node with its state machine, which holds the participant of the middleware.

        No collector frees it in time: it is part of a cycle, and frozen. A thread of the
        participant that outlives the interpreter reads what the end of the process destroys.
        """
        super().destroy_node()
        self.__dict__.pop('_state_machine', None)

    def _destroy(self) -> None:
        """Destroy the entities made since `configure` was called."""
        for kind in _OWNED:
            destroy = getattr(self, f'destroy_{kind.removesuffix("s")}')
            for entity in list(getattr(self, kind)):
                if entity not in self._before[kind]:
                    destroy(entity)
        self._before = {}


def name_of(node: Node) -> str:
    """Return the name of a node for the launcher: with its namespace, without the first slash."""
    return str(node.get_fully_qualified_name().lstrip('/'))


def announce_ready(node: Node) -> None:
    """Report to the launcher, by a line on standard output, that the node is ready."""
    output.announce(f'ready: {name_of(node)}')


def run(make_node: Callable[[], ManagedNode]) -> Any:
    """Run a node until SIGINT, SIGTERM or its shutdown; the main function of every node.

    An executor in a thread of its own serves callbacks. The node's work has the main thread. A
    ValueError at start ends the process with that sentence and exit status 2. From here on no
    output of the process waits for its reader.

    Returns:
        The node, destroyed.
    """
    output.install()
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    stop = Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    node, problem = None, None
    try:
        node = make_node()
        if node.autostart:
            _start(node)
    except ValueError as error:
        problem = str(error)  # the error itself holds the node
    if node is None or problem is not None:
        print(f'error: {problem}', file=sys.stderr, flush=True)
        _limit_end()
        if node is not None:
            node.destroy_node()
        node = None
        gc.collect()  # a node whose making failed
        rclpy.shutdown()
        signal.alarm(0)
        raise SystemExit(2)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = threading.Thread(target=_spin, args=(executor, node, stop), daemon=True)
    spinner.start()
    if period := float(os.environ.get(output.HEARTBEAT, 0)):
        threading.Thread(target=_beat, args=(node, stop, period), daemon=True).start()
    try:
        while not stop.is_set() and not node.ended:
            node.serve(stop)
    finally:
        stop.set()
        spinner.join(2.0)
        try:
            node.end()
        finally:
            _limit_end()
            node.destroy_node()
            rclpy.shutdown()
            signal.alarm(0)
    return node


def _limit_end() -> None:
    """Write what waits, and let the process end if the middleware then hangs."""
    output.close()
    if sys.exc_info()[0] is None:  # an error is yet to be told, and is no end in order
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_DESTROY_TIMEOUT_S)


def _start(node: ManagedNode) -> None:
    node.trigger_configure()
    if node.problem is not None:
        raise node.problem
    node.trigger_activate()


def _beat(node: ManagedNode, stop: Stop, period: float) -> None:
    """Publish heartbeats while the node's work goes on."""
    before: object = None
    while not stop.is_set():
        now = node.signs_of_life
        if now != before and not output.announcing():  # one unread line is enough
            output.announce(f'beat: {name_of(node)}')
        before = now
        time.sleep(period)


def _spin(executor: SingleThreadedExecutor, node: ManagedNode, stop: Stop) -> None:
    while not stop.is_set():
        node.spin_count += 1
        try:
            executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            return
        except InvalidHandle:  # a cleanup destroyed it first
            pass
        except Exception as error:
            # An invalid request, for example. rclpy would ignore the entity from then on.
            node.rejections.add('a callback', error)
            for entity in (*node.services, *node.clients, *node.subscriptions, *node.timers):
                entity._executor_event = False
        time.sleep(YIELD_S)
