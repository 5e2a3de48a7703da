"""The scene of a bag, made a file again: what was recorded needs nothing but its bag."""

from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from bags.errors import BagError
from bags.frames import first_keyframe
from bags.reader import Bag
from session.errors import SessionError
from session.graph import TISSUE_NODE

MESH_FILE = 'tissue.vtk'


def restore_scene(bag: Bag, folder: Path, changes: Mapping[str, str] | None = None) -> Path:
    """Writes a bag's scene, and the tissue of its first keyframe as the scene's mesh.

    A method that was planned is given in it, unless the bag does not name it.

    Args:
        bag: recorded from the start of its session.
        folder: where to; exists.
        changes: by dotted key, in YAML: what is not to be as recorded.

    Returns:
        The scene file.

    Raises:
        BagError: the bag has no scene, or does not begin with the tissue.
        SessionError: a change names no place in the scene.
    """
    text = bag.custom_data.get('scene')
    if text is None:
        raise BagError(f'{bag.path} has no scene: it was recorded without one')
    yaml = YAML()
    scene = yaml.load(text)
    mesh = first_keyframe(bag)
    cells = [('tetra', np.asarray(mesh.tetrahedra, np.int64).reshape(-1, 4))]
    meshio.Mesh(np.asarray(mesh.rest).reshape(-1, 3), cells).write(
        folder / MESH_FILE, file_format='vtk'
    )
    _translate(scene['tissue'])
    scene['tissue']['mesh'] = MESH_FILE
    scene['tissue']['unit'] = 'm'
    if scene['tissue'].get('method') == 'auto':
        for key, value in planned_method(bag).items():
            change(scene, f'tissue.{key}', value)
    for key, value in (changes or {}).items():
        change(scene, key, value)
    path = folder / Path(bag.custom_data.get('scene_file', 'scene.yaml')).name
    out = StringIO()
    yaml.dump(scene, out)
    path.write_text(out.getvalue(), encoding='utf-8')
    return path


def planned_method(bag: Bag) -> dict[str, str]:
    """Keys below `tissue`, in YAML, that make the method given that the session's plan took.

    They are parameters of the simulation; empty where the bag does not have them.
    """
    nodes = YAML(typ='safe', pure=True).load(bag.custom_data.get('parameters', '')) or {}
    found = {
        key: str(value)
        for key, value in nodes.get(f'/{TISSUE_NODE}', {}).items()
        if key.partition('.')[0] in ('model', 'integrator', 'active_region')
    }
    return {'method': 'given', **found} if found else {}


def _translate(tissue: dict[str, Any]) -> None:
    """Says in today's keys what scenes of former versions said in others."""
    integration = tissue.get('integration') or {}
    if 'method' in integration:
        tissue.setdefault('integrator', integration.pop('method'))


def parse_changes(arguments: list[str]) -> dict[str, str]:
    """Dotted keys and values from the form `key=value`.

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
    """Replaces one value of a scene.

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
        new = YAML(typ='safe', pure=True).load(value)
    except YAMLError:
        raise SessionError(f'--with {key}: {value!r} is no value of a scene file') from None
    place = scene
    for part in path:
        inner = place.setdefault(part, {})
        if not isinstance(inner, dict):
            raise SessionError(f'--with {key}: {part} is a value, not a section')
        place = inner
    place[last] = new
