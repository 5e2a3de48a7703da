"""Definitions of message types in the format of bags, from installed packages; no ROS."""

import os
import re
import sys
from pathlib import Path

from cutting_trainer.bags.errors import BagError

SEPARATOR = '=' * 80
_PRIMITIVES = re.compile(r'bool|byte|char|w?string|float(32|64)|u?int(8|16|32|64)')
_FIELD = re.compile(r'^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*')
_HALVES = re.compile(r'^---[ \t]*\n', re.MULTILINE)
_EVENT = (
    'service_msgs/ServiceEventInfo info\n'
    '{package}/{service}_Request[<=1] request\n'
    '{package}/{service}_Response[<=1] response\n'
)


def schema_text(type_name: str) -> str:
    """Return the `ros2msg` text of a type: its own definition, then each contained type once.

    Args:
        type_name: `package/msg/Type`, or `package/srv/Service_Event` for the introspection messages
            of a service; those are composed from the .srv file.

    Raises:
        BagError: a definition is not installed.
    """
    package, folder, name = _split(type_name)
    parts = [_definition(package, folder, name)]
    seen = {f'{package}/{name}'}
    waiting = _dependencies(parts[0], package)
    while waiting:
        dependency = waiting.pop(0)
        if dependency in seen:
            continue
        seen.add(dependency)
        inner_package, inner_name = dependency.split('/')
        inner_folder = 'srv' if _is_half_of_service(inner_package, inner_name) else 'msg'
        text = _definition(inner_package, inner_folder, inner_name)
        parts.append(f'{SEPARATOR}\nMSG: {dependency}\n{text}')
        waiting.extend(_dependencies(text, inner_package))
    return '\n'.join(parts)


def _split(type_name: str) -> tuple[str, str, str]:
    parts = type_name.split('/')
    if len(parts) != 3:
        raise BagError(f'"{type_name[:80]}" is not a message type: expected package/msg/Type')
    return parts[0], parts[1], parts[2]


def _definition(package: str, folder: str, name: str) -> str:
    if folder == 'msg':
        return _read(package, 'msg', f'{name}.msg')
    service, _, half = name.rpartition('_')
    if half == 'Event':
        return _EVENT.format(package=package, service=service)
    request, response = _HALVES.split(_read(package, 'srv', f'{service}.srv'), maxsplit=1)
    return request if half == 'Request' else response


def _is_half_of_service(package: str, name: str) -> bool:
    service, _, half = name.rpartition('_')
    return half in ('Request', 'Response') and _find(package, 'srv', f'{service}.srv') is not None


def _dependencies(text: str, package: str) -> list[str]:
    found = []
    for line in text.splitlines():
        match = _FIELD.match(line)
        if match and not _PRIMITIVES.fullmatch(match[1]):
            parts = match[1].split('/')
            found.append(f'{parts[0] if len(parts) > 1 else package}/{parts[-1]}')
    return found


def _read(package: str, folder: str, file_name: str) -> str:
    path = _find(package, folder, file_name)
    if path is None:
        raise BagError(
            f'no definition {package}/{folder}/{file_name} under share/ of {_prefixes()}: '
            'install the package, or source the workspace that has it'
        )
    return path.read_text(encoding='utf-8')


def _find(package: str, folder: str, file_name: str) -> Path | None:
    for prefix in _prefixes():
        path = Path(prefix, 'share', package, folder, file_name)
        if path.is_file():
            return path
    return None


def _prefixes() -> list[str]:
    """Return the prefixes of ament, and the environment of this interpreter for wheels' files."""
    listed = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return [prefix for prefix in [*listed, sys.prefix] if prefix]
