"""The newest message and the rate of a fast topic."""

from typing import Any

from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.cdr_codec import StampedCodec
from cutting_trainer.node_common.lifecycle import ManagedNode
from cutting_trainer.node_common.rejections import MessageError
from cutting_trainer.viewer.ring_buffers import StreamRate


class Stream:
    """The newest valid message and the rate of a fast topic.

    Args:
        node: to subscribe with.
        message_type, topic: of the messages.
        codec: decodes them.
    """

    def __init__(
        self, node: ManagedNode, message_type: Any, topic: str, codec: StampedCodec
    ) -> None:
        self.newest: Any = None
        self.counter = StreamRate()
        self._codec, self._topic, self._rejections = codec, topic, node.rejections
        self._node = node
        self._subscription = ros.polled(node, message_type, topic, qos.NEWEST_BEST_EFFORT)

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def poll(self, now: float) -> None:
        """Take the messages that have arrived by a time [s]."""
        if (taken := ros.take_numbered(self._subscription)) is not None:
            self.counter.see(now, taken[1])
            try:
                sample = self._codec.believed(taken[0])
            except MessageError as error:
                self._rejections.add(self._topic, error)
                return
            if sample.stamp_ns:  # 0: there is no device yet
                self.newest = sample
