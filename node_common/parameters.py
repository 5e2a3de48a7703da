"""Declaration of node parameters with description, unit, range and whether they may change."""

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

MAX_SEED = 2**63 - 1


def parameter(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    within: tuple[float, float] | None = None,
    constraints: str = '',
    settable: bool = False,
) -> Any:
    """Declare a parameter and return its value.

    Args:
        node: its owner.
        name: of the parameter.
        default: value without one from outside; its type is the parameter's type.
        description: meaning, with unit.
        within: smallest and largest value, both allowed.
        constraints: further constraints, in words.
        settable: whether it may change while the node runs; else it is read-only.

    Raises:
        ValueError: its value has another type or is out of range.
    """
    if node.has_parameter(name):  # of a node that is configured again
        return node.get_parameter(name).value
    descriptor = ParameterDescriptor(
        description=description, additional_constraints=constraints, read_only=not settable
    )
    if within is not None and isinstance(default, int):
        least, most = map(int, within)
        descriptor.integer_range = [IntegerRange(from_value=least, to_value=most, step=1)]
    elif within is not None:
        low, high = within
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    try:
        return node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        wanted = f', {within[0]:g} to {within[1]:g}' if within else ''
        raise ValueError(
            f'parameter {name} of {node.get_name()} must be of type {type(default).__name__}'
            f'{wanted} ({description}): {error}'
        ) from None


def announced(node: Node, name: str, value: Any, description: str) -> None:
    """Declare a read-only parameter that publishes a choice of the node.

    Args:
        node: its owner.
        name: of the parameter.
        value: of the parameter.
        description: meaning, with unit.
    """
    if not node.has_parameter(name):  # else it is configured again
        descriptor = ParameterDescriptor(description=description, read_only=True)
        node.declare_parameter(name, value, descriptor, ignore_override=True)


def scene_parameter(node: Node) -> str:
    """Return the path of the scene file, parameter `scene`."""
    return str(
        parameter(node, 'scene', '', 'path of the scene file', constraints='an existing .yaml file')
    )


def tool_parameter(node: Node) -> str:
    """Return the name of the node's tool in the scene's section `tools`, parameter `tool`."""
    text = "name in the scene's section `tools`; empty: the first tool"
    return str(parameter(node, 'tool', '', text))


def seed_parameter(node: Node) -> int:
    """Return the seed of all random numbers of the node, parameter `seed`."""
    text = 'seed of everything random [-]'
    return int(parameter(node, 'seed', 0, text, within=(0, MAX_SEED)))


def max_message_parameter(node: Node, default: int) -> int:
    """Return the size of the largest accepted message [bytes], parameter `max_message`."""
    text = 'largest message that is accepted, meshes aside: max_nodes bounds those [bytes]'
    return int(parameter(node, 'max_message', default, text, within=(1024, 2**32)))
