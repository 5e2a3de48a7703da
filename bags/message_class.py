"""The Python classes of messages by the names that the graph gives their types."""

from importlib import import_module
from typing import Any

from bags.errors import BagError


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
