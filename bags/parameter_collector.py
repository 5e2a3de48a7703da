"""Collector of the parameters of all nodes of the graph, for the bag."""

from typing import Any

import yaml
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python


class ParameterCollector:
    """Requests the parameters of each node when it first appears; nothing waits for the answers.

    Later changes are not requested: they are on /parameter_events, and so in the bag.

    Args:
        node: its services are used for the requests.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._values: dict[str, dict[str, Any]] = {}
        self._waiting: dict[str, list[Any]] = {}

    @property
    def text(self) -> str:
        """Return the known parameters as YAML: values by name by node; '' while there are none."""
        known = dict(sorted(self._values.items()))
        return str(yaml.safe_dump(known, sort_keys=True)) if known else ''

    def look(self) -> None:
        """Request the parameters of nodes that are new since the last call."""
        for name, namespace in self._node.get_node_names_and_namespaces():
            full = f'{namespace.rstrip("/")}/{name}'
            if full in self._values:
                for client in self._waiting.pop(full, []):
                    self._node.destroy_client(client)
                continue
            if full not in self._waiting:
                self._waiting[full] = [
                    self._node.create_client(ListParameters, f'{full}/list_parameters'),
                    self._node.create_client(GetParameters, f'{full}/get_parameters'),
                ]
                continue  # the services appear some time after the node
            listing, getting = self._waiting[full]
            if listing.service_is_ready() and getting.service_is_ready():
                self._ask(full, listing, getting)

    def _ask(self, node: str, listing: Any, getting: Any) -> None:
        def listed(future: Any) -> None:
            names = sorted(future.result().result.names)
            answer = getting.call_async(GetParameters.Request(names=names))
            answer.add_done_callback(lambda done: got(names, done.result().values))

        def got(names: list[str], values: list[Any]) -> None:
            plain = map(parameter_value_to_python, values)
            self._values[node] = {
                name: list(value)
                if hasattr(value, '__len__') and not isinstance(value, str)
                else value
                for name, value in zip(names, plain, strict=False)
            }

        listing.call_async(ListParameters.Request()).add_done_callback(listed)
