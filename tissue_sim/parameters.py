"""Parameters of nodes, each with what it means, its unit and range, and whether it may change."""

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from tissue_sim.replica import MOST_NODES

LARGEST_SEED = 2**63 - 1


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
    """Declares a parameter and returns its value.

    Args:
        node: that has it.
        name: of it.
        default: value without one from outside; its type is the parameter's.
        description: what it means, with its unit.
        within: least and largest value, both allowed.
        constraints: what else it must be, in words.
        settable: may change while the node runs; else it is read-only after the start.

    Raises:
        ValueError: it was given a value of another type, or out of its range.
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
    """Declares a parameter that says what the node does; it cannot be given from outside.

    Args:
        node: that has it.
        name: of it.
        value: that it has.
        description: what it means, with its unit.
    """
    if not node.has_parameter(name):  # else it is configured again, and says what it said
        descriptor = ParameterDescriptor(description=description, read_only=True)
        node.declare_parameter(name, value, descriptor, ignore_override=True)


def scene_parameter(node: Node) -> str:
    """Path of the scene file, `scene`."""
    return str(
        parameter(node, 'scene', '', 'path of the scene file', constraints='an existing .yaml file')
    )


def seed_parameter(node: Node) -> int:
    """Seed of everything random in the node, `seed`."""
    text = 'seed of everything random [-]'
    return int(parameter(node, 'seed', 0, text, within=(0, LARGEST_SEED)))


def max_nodes_parameter(node: Node) -> int:
    """Largest mesh that the node accepts, `max_nodes`."""
    text = 'nodes of a mesh that is accepted; of tetrahedra and triangles eight times as many [-]'
    return int(parameter(node, 'max_nodes', MOST_NODES, text, within=(4, 2**28)))


def max_message_parameter(node: Node, default: int) -> int:
    """Largest message that the node accepts [bytes], `max_message`."""
    text = 'largest message that is accepted, meshes aside: max_nodes bounds those [bytes]'
    return int(parameter(node, 'max_message', default, text, within=(1024, 2**32)))
