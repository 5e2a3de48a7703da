"""Import of Python message classes by type name."""

import re
from importlib import import_module
from typing import Any

from cutting_trainer.bags.errors import BagError

_COMMON = (
    *('actionlib', 'diagnostic', 'geometry', 'nav', 'sensor', 'shape', 'std', 'stereo'),
    *('trajectory', 'visualization'),
)
PACKAGES = frozenset(
    {
        *('cutting_trainer_msgs', 'crtk_msgs', 'omni_msgs', 'std_srvs', 'tf2_msgs'),
        *(f'{name}_msgs' for name in _COMMON),
        *('action_msgs', 'builtin_interfaces', 'composition_interfaces', 'lifecycle_msgs'),
        *('rcl_interfaces', 'rosgraph_msgs', 'service_msgs', 'statistics_msgs'),
        *('type_description_interfaces', 'unique_identifier_msgs'),
    }
)
"""Packages whose modules may be imported: an import runs code, and a bag can name any type."""
_NAME = re.compile(r'([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)')


def message_class(type_name: str) -> Any:
    """Return the Python class of `package/msg/Type` or `package/srv/Service_Event`.

    Raises:
        BagError: its package is not in `PACKAGES`, or not installed in this environment.
    """
    match = _NAME.fullmatch(type_name)
    if match is None:
        raise BagError(f'"{type_name[:80]}" is not a message type: expected package/msg/Type')
    package, folder, name = match.groups()
    if package not in PACKAGES:
        raise BagError(
            f'the message type {type_name[:80]} is of a package that the trainer does not load: '
            'it records and plays its own, CRTK, and those of ROS itself'
        )
    try:
        return getattr(import_module(f'{package}.{folder}'), name)
    except (ImportError, AttributeError, ValueError):
        raise BagError(
            f'the message type {type_name} is not installed: '
            f'build or install {package}, then source it'
        ) from None
