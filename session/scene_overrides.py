"""A scene with some values replaced, as a file that nodes can read."""

from collections.abc import Mapping
from io import StringIO
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from cutting_trainer.node_common.scene_reader import check_yaml
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import Scene


def write_changed(scene: Scene, folder: Path, changes: Mapping[str, str]) -> Path:
    """Write a scene under its own name.

    Args:
        scene: as it is.
        folder: where to; exists.
        changes: by dotted key, in YAML.

    Returns:
        The file.

    Raises:
        SessionError: a change names no place in the scene.
    """
    yaml = YAML()
    content = yaml.load(scene.path.read_text(encoding='utf-8'))
    content['tissue']['mesh'] = str(scene.tissue.mesh)
    for key, value in changes.items():
        change(content, key, value)
    path, out = folder / scene.path.name, StringIO()
    yaml.dump(content, out)
    path.write_text(out.getvalue(), encoding='utf-8')
    return path


def parse_changes(arguments: list[str]) -> dict[str, str]:
    """Return dotted keys and values from the form `key=value`.

    Raises:
        SessionError: one has another form.
    """
    changes = {}
    for argument in arguments:
        key, equals, value = argument.partition('=')
        if not equals or not key.strip() or not value.strip():
            raise SessionError(
                f'--with {argument}: write key=value, as in tissue.material.toughness=40'
            )
        changes[key.strip()] = value.strip()
    return changes


def change(scene: dict[str, object], key: str, value: str) -> None:
    """Replace one value of a scene.

    Args:
        scene: as read from its file.
        key: dotted, as in `tissue.material.toughness`.
        value: in YAML.

    Raises:
        SessionError: the key names no place, or the value is none.
    """
    *path, last = key.split('.')
    if not path:
        raise SessionError(f'--with {key}: give section and key, as in cutting.{key}')
    try:
        check_yaml(value)
        new = YAML(typ='safe', pure=True).load(value)
    except (YAMLError, ValueError):
        raise SessionError(f'--with {key}: {value!r} is not a value in YAML') from None
    place = scene
    for part in path:
        inner = place.setdefault(part, {})
        if not isinstance(inner, dict):
            raise SessionError(f'--with {key}: {part} has no keys, it is a value')
        place = inner
    place[last] = new
