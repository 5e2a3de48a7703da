"""The ROS side of reading a bag: from recorded bytes to message objects."""

from importlib import import_module
from typing import Any

from rclpy.serialization import deserialize_message

from bags.errors import BagError
from bags.reader import Recorded


def message_class(type_name: str) -> Any:
    """The Python class of `package/msg/Type` or `package/srv/Service_Event`.

    Raises:
        BagError: it is not installed in this environment.
    """
    package, _, rest = type_name.partition('/')
    folder, _, name = rest.partition('/')
    try:
        return getattr(import_module(f'{package}.{folder}'), name)
    except (ImportError, AttributeError, ValueError):
        raise BagError(
            f'the message type {type_name} is not installed: '
            f'build or install {package}, then source it'
        ) from None


def decode(recorded: Recorded) -> Any:
    """The message object of what a bag has."""
    return deserialize_message(recorded.data, message_class(recorded.type))
