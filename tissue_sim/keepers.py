"""Asking the followers of the tissue for it, when the node that owned it has died."""

import time
from typing import Any

import rclpy
from cutting_trainer_msgs.msg import Mesh
from cutting_trainer_msgs.srv import GetMesh
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from tissue_sim import ros

PATIENCE = 3.0
"""[s] that all of them together have to be found and to answer."""
OTHERS = 0.5
"""[s] that the others still have when one has answered."""


def ask_keepers(node: Node) -> list[Mesh]:
    """The tissue as each of `ros.MESH_KEEPERS` knows it; those that know none are left out.

    Args:
        node: on whose behalf. It may be in a callback: another node asks.
    """
    name = f'{node.get_name()}_asks'
    asker = rclpy.create_node(name, namespace=node.get_namespace(), use_global_arguments=False)
    executor = SingleThreadedExecutor()
    executor.add_node(asker)
    try:
        waiting = [asker.create_client(GetMesh, service) for service in ros.MESH_KEEPERS]
        asked: list[Any] = []
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and (waiting or not all(f.done() for f in asked)):
            for client in [c for c in waiting if c.service_is_ready()]:
                waiting.remove(client)
                asked.append(client.call_async(GetMesh.Request()))
            executor.spin_once(timeout_sec=0.02)
            if any(future.done() for future in asked):
                deadline = min(deadline, time.monotonic() + OTHERS)
        answers = [future.result() for future in asked if future.done()]
    finally:
        executor.shutdown()
        asker.destroy_node()
    return [answer.mesh for answer in answers if answer is not None and answer.success]
