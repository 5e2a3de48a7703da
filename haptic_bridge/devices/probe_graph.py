"""Check of the publishers and subscribers of a device's topics, by the ROS graph.

Limitations: the graph lists names, types and QoS, not the use of a message: a subscriber
that ignores every force counts as one that uses it.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy

PASSIVE_SUBSCRIBERS = ('recorder', 'viewer', 'rosbag2_recorder', 'probe_device')
"""Nodes that subscribe to a force and pass it to no hand, whatever namespace they share."""
_COMMAND_LINE = '_ros2cli'
_REMEDY = (
    'build that package into the trainer with `./trainer overlay FOLDER_OF_ITS_SOURCES`, or source '
    'a workspace that has it, then start again'
)


class Wiring:
    """Checks the graph for a subscriber of the force, and for types that do not match.

    Args:
        node: to look with.
        force: publisher of the force.
        types: message class of each topic that has to be understood, by its name.
    """

    def __init__(self, node: Any, force: Publisher, types: Mapping[str, Any]) -> None:
        self._node = node
        self._force = force
        self._force_type = type_name(force.msg_type)
        self._types = {node.resolve_topic_name(name): kind for name, kind in types.items()}

    def cause(self) -> str:
        """Return why no force may be commanded, as a sentence; '' where nothing is wrong."""
        for topic, kind in self._types.items():
            publishers = self._node.get_publishers_info_by_topic(topic)
            if foreign := [p for p in publishers if p.topic_type != type_name(kind)]:
                return (
                    f'{topic} comes from {_names(foreign)} as {foreign[0].topic_type}, and this '
                    f'node reads {type_name(kind)}, so nothing of it is heard: {_REMEDY}'
                )
        return self._untaken()

    def _untaken(self) -> str:
        """Return why the force reaches no hand."""
        topic = self._force.topic_name
        hearing = [s for s in self._subscriptions(topic) if not self._only_listens(s)]
        if other := [s for s in hearing if s.topic_type != self._force_type]:
            hearing = [s for s in hearing if s.topic_type == self._force_type]
            if not hearing:
                return (
                    f'{_names(other)} takes {topic} as {other[0].topic_type}, and the force is '
                    f'sent as {self._force_type}: the driver has to take that'
                )
        if any(self._matches(s) for s in hearing):
            return ''
        if hearing:
            return (
                f'{_names(hearing)} asks for {topic} latched (transient local), which never '
                'matches: it has to ask for volatile'
            )
        return f'nobody takes the force on {topic}: {self._elsewhere(topic)}'

    def _elsewhere(self, topic: str) -> str:
        """Return a remedy, with the topics on which a subscriber waits for a force."""
        found = sorted(
            name
            for name, types in self._node.get_topic_names_and_types()
            if name.endswith('servo_cf') and name != topic and self._force_type in types
            if any(not self._only_listens(s) for s in self._subscriptions(name))
        )
        there = (
            f'there is {", ".join(found)}: name it'
            if found
            else 'start the driver, or name the topic that it subscribes to'
        )
        return (
            f'{there} with device.force_topic of the scene or the launch arguments arm and '
            'force_topic (recorder and viewer only listen)'
        )

    def _subscriptions(self, topic: str) -> list[Any]:
        return list(self._node.get_subscriptions_info_by_topic(topic))

    def _matches(self, subscription: Any) -> bool:
        # Not `qos_check_compatible`: it takes the infinite deadline of the graph for a deadline.
        asked = subscription.qos_profile.durability
        return asked in (DurabilityPolicy.VOLATILE, self._force.qos_profile.durability)

    def _only_listens(self, subscription: Any) -> bool:
        """Return whether it is a recorder or a viewer, in this node's namespace or above it."""
        if subscription.node_name.startswith(_COMMAND_LINE):
            return True
        above = f'{subscription.node_namespace.rstrip("/")}/'
        ours = f'{self._node.get_namespace().rstrip("/")}/'
        return subscription.node_name in PASSIVE_SUBSCRIBERS and ours.startswith(above)


def type_name(kind: Any) -> str:
    """Return a message class as the graph names it, as in `geometry_msgs/msg/WrenchStamped`."""
    package, folder, *_ = kind.__module__.split('.')
    return f'{package}/{folder}/{kind.__name__}'


def _names(endpoints: Iterable[Any]) -> str:
    full = {f'{e.node_namespace.rstrip("/")}/{e.node_name}' for e in endpoints}
    return ' and '.join(sorted(full))
