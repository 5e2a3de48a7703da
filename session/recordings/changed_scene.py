"""A scene with some values replaced, as a file that nodes can read."""

from collections.abc import Mapping
from io import StringIO
from pathlib import Path

from ruamel.yaml import YAML

from session.recordings.recorded_scene import change
from session.scene import Scene


def write_changed(scene: Scene, folder: Path, changes: Mapping[str, str]) -> Path:
    """Writes a scene under its own name.

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
