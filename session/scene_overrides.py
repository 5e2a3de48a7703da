"""A scene with some values replaced, as a file that nodes can read."""

import json
import re
from collections.abc import Collection, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from cutting_trainer.haptic_bridge.scene_schema import SettingsError
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.scene_reader import check_yaml
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import Scene, load_scene
from cutting_trainer.tissue_sim.scene_schema import TissueSettings


def write_changed(scene: Scene, folder: Path, changes: Mapping[str, str], name: str = '') -> Path:
    """Write a changed scene.

    Args:
        scene: as it is.
        folder: where to; exists.
        changes: by dotted key, in YAML.
        name: of the changed scene; '': its own.

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
    path, out = folder / f'{name or scene.path.stem}.yaml', StringIO()
    yaml.dump(content, out)
    path.write_text(out.getvalue(), encoding='utf-8')
    return path


def load_changed(path: Path, changes: Collection[str]) -> Scene:
    """Read a scene that a command has changed.

    Args:
        path: file of the changed scene; nobody can look into it later.
        changes: dotted keys that the user has given.

    Raises:
        SessionError: a value is not valid.
        SceneError, SettingsError: the same, without changes.
    """
    try:
        return load_scene(str(path))
    except (SceneError, SettingsError) as error:
        if not changes:
            raise
        said = re.sub(rf'^{re.escape(str(path))}(:\d+)?: ', '', str(error))
        raise SessionError(f'--with {", ".join(changes)}: {said}') from None


def parse_changes(arguments: list[str]) -> dict[str, str]:
    """Return dotted keys and values from the form `key=value`.

    Raises:
        SessionError: one has another form.
    """
    changes = {}
    for argument in arguments:
        key, equals, value = argument.partition('=')
        key, value = key.strip(), value.strip()
        if not equals or not key or not value:
            raise SessionError(
                f'--with {argument}: write key=value, as in tissue.material.toughness=40'
            )
        changes[key] = _absolute(value) if key == 'tissue.mesh' else value
    return changes


def _absolute(mesh: str) -> str:
    """Return a path in YAML for a scene in another folder; one that is no text stays."""
    try:
        path = YAML(typ='safe', pure=True).load(mesh)
    except (YAMLError, ValueError):
        return mesh
    return (
        json.dumps(str(Path(path).resolve()), ensure_ascii=False) if isinstance(path, str) else mesh
    )


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
    new = value_of(key, value)
    place = scene
    for part in path:
        inner = place.setdefault(part, {})
        if not isinstance(inner, dict):
            raise SessionError(f'--with {key}: {part} has no keys, it is a value')
        place = inner
    place[last] = new


def value_of(key: str, text: str) -> Any:
    """Return the value that YAML has for a changed key.

    Raises:
        SessionError: it is none.
    """
    try:
        check_yaml(text)
        return YAML(typ='safe', pure=True).load(text)
    except (YAMLError, ValueError):
        raise SessionError(f'--with {key}: {text!r} is not a value in YAML') from None


def tissue_changes(tissue: TissueSettings, factors: Mapping[str, float]) -> dict[str, str]:
    """Return the changes that make a tissue stiffer or tougher, in all its regions.

    Args:
        tissue: as its scene has it.
        factors: of Young's modulus, `stiffness`, and of `toughness`.
    """
    changes = {}
    names = {'youngs_modulus': factors['stiffness'], 'toughness': factors['toughness']}
    changed = {name: factor for name, factor in names.items() if factor != 1.0}
    for name, factor in changed.items():
        changes[f'tissue.material.{name}'] = f'{factor * getattr(tissue.material, name):g}'
    if changed and tissue.regions:
        regions = [
            region.model_dump(exclude_none=True)
            | {name: factor * tissue.region_values(name)[i] for name, factor in changed.items()}
            for i, region in enumerate(tissue.regions)
        ]
        changes['tissue.regions'] = json.dumps(regions)
    return changes
