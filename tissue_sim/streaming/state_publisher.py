"""Publisher of the whole simulation state, for a recorder that starts within a session."""

import threading
import time
from collections.abc import Iterator

import numpy as np
from cutting_trainer_msgs.msg import State
from rclpy.publisher import Publisher

from cutting_trainer.node_common import ros
from cutting_trainer.tissue_sim.simulation.serialisation import ObjectState
from cutting_trainer.tissue_sim.streaming.messages import packed

_SUBSCRIPTION_DELAY_S = 0.5
"""After a new subscription: by then the recorder receives the inputs of frames, too."""
_MAX_PART_BYTES = 1 << 19
"""Size of a message; larger ones would overrun the buffers of sockets."""
_PAUSE_S = 0.002
_CLOSE_TIMEOUT_S = 1.0


class StatePublisher:
    """Publishes states in parts, in a thread.

    Args:
        publisher: of `State` messages.
    """

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._heard_by = 0
        self._due = 0.0
        self._thread: threading.Thread | None = None

    def is_wanted(self) -> bool:
        """Return whether a new subscriber has been there long enough to receive all topics."""
        count = self._publisher.get_subscription_count()
        if count > self._heard_by:
            self._due = time.monotonic() + _SUBSCRIPTION_DELAY_S
        self._heard_by = count
        idle = self._thread is None or not self._thread.is_alive()
        return bool(count) and idle and 0.0 < self._due <= time.monotonic()

    def publish(self, state: ObjectState, step: int) -> None:
        """Start to publish a state; returns at once.

        Args:
            state: to publish.
            step: frame that begins from it.
        """
        self._due = 0.0
        self.close()
        self._thread = threading.Thread(target=self._send, args=(state, step), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Wait until a started state is published."""
        if self._thread is not None:
            self._thread.join(_CLOSE_TIMEOUT_S)

    def _send(self, state: ObjectState, step: int) -> None:
        for message in state_messages(state, step, time.time_ns()):
            self._publisher.publish(message)
            time.sleep(_PAUSE_S)


def state_messages(state: ObjectState, step: int, time_ns: int) -> Iterator[State]:
    """Return the messages of a state, part by part.

    Args:
        state: to publish.
        step: frame that begins from it.
        time_ns: stamp [ns].
    """
    parts = max(-(-len(state.data) // _MAX_PART_BYTES), 1)
    for part in range(parts):
        message = State(step=step, part=part, parts=parts, tree=state.tree if part == 0 else '')
        message.header.frame_id = ros.FRAME
        message.header.stamp = ros.stamp(time_ns)
        some = state.data[part * _MAX_PART_BYTES : (part + 1) * _MAX_PART_BYTES]
        message.data = packed('B', np.frombuffer(some, np.uint8))
        yield message
