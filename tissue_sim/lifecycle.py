"""The life of a node: configured, active, resting, and its process around it.

States and transitions are those of ROS 2's managed nodes (design.ros2.org, "Managed nodes").
"""

import faulthandler
import gc
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

from tissue_sim.parameters import max_message_parameter, parameter
from tissue_sim.refusals import Refusals

COLLECTED = 20_000
"""New objects after which the garbage collector looks at them."""
BREATH = 0.0005
"""[s] between two callbacks: a flood of messages must not take the interpreter from the loops."""
REST_TIMEOUT = 5.0
"""[s] in which a node that is deactivated must have left its work."""
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_OWNED = ('publishers', 'subscriptions', 'clients', 'services', 'timers')


class Stop:
    """A flag that a signal handler may set at any moment; `threading.Event` can deadlock there.

    Args:
        also: asks for the end, too, when it is true.
    """

    def __init__(self, also: Callable[[], bool] = lambda: False) -> None:
        self._set = False
        self._also = also

    def set(self) -> None:
        """Asks for the end."""
        self._set = True

    def is_set(self) -> bool:
        """Whether the end is asked for."""
        return self._set or self._also()

    def wait(self) -> None:
        """Returns soon after `set`."""
        while not self.is_set():
            time.sleep(0.05)


class ManagedNode(LifecycleNode):
    """A node that configures, activates, deactivates, cleans up and shuts down on request.

    UNCONFIGURED it has its parameters, INACTIVE it has read the scene and made its topics, ACTIVE
    it works. A subclass gives `configure`, and what else it needs of `work`, `rest` and `release`.

    Parameters:
        autostart: become ACTIVE at once. Without, a lifecycle manager does it.
        max_message: bytes of a message that is accepted, meshes aside.

    Attributes:
        refusals: what the node could not use.
        max_message: the parameter.
        problem: why the last configuration failed, or None.
        ended: it was shut down: its process is to end.
    """

    largest_message = 1 << 20
    """Default of `max_message`."""

    def __init__(self, name: str) -> None:
        # Which writes a line into the log for each request that is not right, as many as come.
        self._callback_group = ReentrantCallbackGroup()
        mute = Parameter('start_type_description_service', value=False)
        super().__init__(name, parameter_overrides=[mute])
        self.refusals = Refusals()
        self.max_message = max_message_parameter(self, self.largest_message)
        self.problem: Exception | None = None
        self.ended = False
        self._active = False
        self._turn = threading.Lock()
        self._resting = threading.Event()
        self._resting.set()
        self._before: dict[str, list[Any]] = {}
        text = 'become ACTIVE at once; else a lifecycle manager configures and activates the node'
        self.autostart = bool(parameter(self, 'autostart', True, text))

    @property
    def default_callback_group(self) -> CallbackGroup:
        """Reentrant: one thread serves it, and what could not be taken must not block the rest."""
        return self._callback_group

    @property
    def is_active(self) -> bool:
        """Whether it works."""
        return self._active

    def configure(self) -> None:
        """Reads what it needs and makes its topics and services.

        Raises:
            ValueError: it cannot be like this; the node stays UNCONFIGURED.
        """

    def work(self, stop: Stop) -> None:
        """Works in the main thread until `stop` is set: the node is ACTIVE so long."""
        announce_ready(self)
        stop.wait()

    def rest(self) -> None:
        """Is called after the work, when the node becomes INACTIVE."""

    def release(self) -> None:
        """Is called before what `configure` made is destroyed."""

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:  # noqa: N802
        """As of rclpy, which leaves unanswered what the state does not allow."""
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
        if not self._resting.wait(REST_TIMEOUT):
            self.get_logger().error(f'still at work {REST_TIMEOUT:g} s after it was deactivated')
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
        """Works once it is ACTIVE, and returns when it is no more; called again and again."""
        with self._turn:
            if self._active:
                self._resting.clear()
        if self._resting.is_set():
            time.sleep(0.02)
            return
        # What lives as long as the node is looked at no more, and the rest not all the time: it was
        # a quarter of what the recorder did.
        gc.freeze()
        gc.set_threshold(COLLECTED)
        try:
            self.work(Stop(lambda: stop.is_set() or not self._active))
        finally:
            self._resting.set()

    def end(self) -> None:
        """Rests and releases, as far as that is still to be done."""
        if self._active:
            self._active = False
            self.rest()
        if self._before:
            self.release()

    def _destroy(self) -> None:
        """Destroys what has been made since `configure` was called."""
        for kind in _OWNED:
            destroy = getattr(self, f'destroy_{kind.removesuffix("s")}')
            for entity in list(getattr(self, kind)):
                if entity not in self._before[kind]:
                    destroy(entity)
        self._before = {}


def announce_ready(node: Node) -> None:
    """Tells the launcher, by a line on standard output, that the node does its work."""
    print(f'ready: {node.get_name()}', flush=True)


def run(make_node: Callable[[], ManagedNode]) -> Any:
    """Runs a node to SIGINT, SIGTERM or its shutdown, and ends it in order; the main of every node.

    Callbacks are served by an executor in a thread of its own, the node's work has the main thread.
    A ValueError while the node starts ends the process with that one sentence and exit status 2.

    Returns:
        The node, destroyed.
    """
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    stop = Stop()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        node = make_node()
        if node.autostart:
            _start(node)
    except ValueError as error:
        print(f'error: {error}', file=sys.stderr, flush=True)
        rclpy.shutdown()
        raise SystemExit(2) from None
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = threading.Thread(target=_spin, args=(executor, node, stop), daemon=True)
    spinner.start()
    try:
        while not stop.is_set() and not node.ended:
            node.serve(stop)
    finally:
        stop.set()
        spinner.join(2.0)
        node.end()
        node.destroy_node()
        rclpy.shutdown()
    return node


def _start(node: ManagedNode) -> None:
    node.trigger_configure()
    if node.problem is not None:
        raise node.problem
    node.trigger_activate()


def _spin(executor: SingleThreadedExecutor, node: ManagedNode, stop: Stop) -> None:
    while not stop.is_set():
        try:
            executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            return
        except InvalidHandle:  # was destroyed by a cleanup before its turn came
            pass
        except Exception as error:
            # A request of which nothing is right, say: no reason to be deaf from then on, as rclpy
            # would be for an entity of which it could not take what had come.
            node.refusals.add('a callback', error)
            for entity in (*node.services, *node.clients, *node.subscriptions, *node.timers):
                entity._executor_event = False
        time.sleep(BREATH)
