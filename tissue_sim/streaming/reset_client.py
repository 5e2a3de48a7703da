"""Client of the service `tissue/reset`, which `tissue_sim/node.py` serves."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from cutting_trainer.node_common import ros


class ResetClient:
    """Client by which an operator resets the tissue.

    Args:
        node: the client's node.
        warn: called with a sentence where the tissue stays as it is; may be called by any thread.
    """

    def __init__(self, node: Node, warn: Callable[[str], None]) -> None:
        self._client = node.create_client(Trigger, ros.RESET_TISSUE)
        self._warn = warn

    def ask(self) -> None:
        """Request the reset without waiting."""
        if not self._client.service_is_ready():
            self._warn('The node tissue_sim does not answer: the tissue stays as it is.')
            return
        self._client.call_async(Trigger.Request()).add_done_callback(self._answered)

    def _answered(self, future: Any) -> None:
        response = future.result()
        if response is None or not response.success:
            why = f' {response.message}' if response is not None else ''
            self._warn(f'The tissue stays as it is.{why}')
