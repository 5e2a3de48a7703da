"""Recovery of the tissue from its followers after the node that owned it has died."""

import time
from typing import Any

import rclpy
from cutting_trainer_msgs.msg import Mesh
from cutting_trainer_msgs.srv import GetMesh
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from cutting_trainer.node_common import ros

RECOVERY_TIMEOUT_S = 3.0
"""Time for all services together to be found and to reply."""
LATE_REPLY_TIMEOUT_S = 0.5
"""Time for the other services after the first reply."""


def recover_meshes(node: Node) -> list[Mesh]:
    """Return the tissue from each of `ros.MESH_RECOVERY_SERVICES` that knows it.

    Args:
        node: on whose behalf; it may be in a callback, because another node makes the requests.
    """
    name = f'{node.get_name()}_asks'
    asker = rclpy.create_node(name, namespace=node.get_namespace(), use_global_arguments=False)
    executor = SingleThreadedExecutor()
    executor.add_node(asker)
    try:
        waiting = [asker.create_client(GetMesh, service) for service in ros.MESH_RECOVERY_SERVICES]
        asked: list[Any] = []
        deadline = time.monotonic() + RECOVERY_TIMEOUT_S
        while time.monotonic() < deadline and (waiting or not all(f.done() for f in asked)):
            for client in [c for c in waiting if c.service_is_ready()]:
                waiting.remove(client)
                asked.append(client.call_async(GetMesh.Request()))
            executor.spin_once(timeout_sec=0.02)
            if any(future.done() for future in asked):
                deadline = min(deadline, time.monotonic() + LATE_REPLY_TIMEOUT_S)
        answers = [future.result() for future in asked if future.done()]
    finally:
        executor.shutdown()
        asker.destroy_node()
    return [answer.mesh for answer in answers if answer is not None and answer.success]
