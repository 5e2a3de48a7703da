"""Topic `haptic_bridge/indexing`: how the hand moves the tool, for recorder and page."""

import time

from cutting_trainer_msgs.msg import Indexing

from cutting_trainer.haptic_bridge.hand_coupling import HandCoupling
from cutting_trainer.haptic_bridge.indexing import Indexing as HandIndexing
from cutting_trainer.node_common import qos, ros
from cutting_trainer.node_common.lifecycle import ManagedNode


class IndexingTopic:
    """Publishes each change, and the first indexing at once.

    Args:
        node: to publish with.
        coupling: of hand and tool.
    """

    def __init__(self, node: ManagedNode, coupling: HandCoupling) -> None:
        self._unsent = coupling.unsent
        self._publisher = node.create_publisher(Indexing, ros.INDEXING, qos.HISTORY)
        self._publish(coupling.indexing._replace(after_ns=time.time_ns()))

    def publish_changes(self) -> None:
        """Publish the changes since the last call."""
        while self._unsent:
            self._publish(self._unsent.popleft())

    def _publish(self, indexing: HandIndexing) -> None:
        values = indexing._asdict()
        message = Indexing()
        message.header.frame_id = ros.FRAME
        message.header.stamp = ros.stamp(values.pop('after_ns'))
        for name, value in values.items():
            setattr(message, name, value)
        self._publisher.publish(message)
