"""Extraction of the scene from a bag: a recording needs no file but its bag."""

import re
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.metadata import recorded_parameters
from cutting_trainer.bags.reader import Bag
from cutting_trainer.bags.recorded_frames import first_keyframe
from cutting_trainer.bags.untrusted_yaml import text_by_key
from cutting_trainer.node_common.scene_reader import check_yaml
from cutting_trainer.node_common.yaml_bounds import YamlBoundError
from cutting_trainer.session.node_commands import TISSUE_NODE
from cutting_trainer.session.scene_overrides import change

MESH_FILE = 'tissue.vtk'
_SCENE_FILE = re.compile(r'[\w.-]{1,100}\.ya?ml')


def restore_scene(bag: Bag, folder: Path, changes: Mapping[str, str] | None = None) -> Path:
    """Write the scene of a bag, with the tissue of its first keyframe as mesh.

    The scene names the contact, and the planned method if the bag has it.

    Args:
        bag: bag, recorded from the start of its session.
        folder: existing folder to write to.
        changes: changed values in YAML, by dotted key.

    Returns:
        The scene file.

    Raises:
        BagError: the bag has no scene, or does not begin with the tissue.
        SessionError: a change has a key that the scene cannot have.
    """
    text = bag.custom_data.get('scene')
    if text is None:
        raise BagError(f'{bag.path} has no scene: it was recorded without one')
    yaml = YAML()
    scene = _mapping(yaml, text, f'the scene of {bag.path}')
    if not isinstance(scene.get('tissue'), dict):
        raise BagError(f'the scene of {bag.path} has no section tissue')
    mesh = first_keyframe(bag)
    cells = [('tetra', np.asarray(mesh.tetrahedra, np.int64).reshape(-1, 4))]
    labels = _labels(bag, scene['tissue'], np.array(getattr(mesh, 'region', ()), np.int64))
    meshio.Mesh(np.asarray(mesh.rest).reshape(-1, 3), cells, cell_data=labels).write(
        folder / MESH_FILE, file_format='vtk'
    )
    _translate(scene)
    if 'contact' not in scene['tissue']:
        scene['tissue']['contact'] = recorded_contact(bag)
    scene['tissue']['mesh'] = MESH_FILE
    scene['tissue']['unit'] = 'm'
    if scene['tissue'].get('method') == 'auto':
        for key, value in planned_method(bag).items():
            change(scene, f'tissue.{key}', value)
    for key, value in (changes or {}).items():
        change(scene, key, value)
    name = Path(bag.custom_data.get('scene_file', '')).name
    path = folder / (name if _SCENE_FILE.fullmatch(name) else 'scene.yaml')
    out = StringIO()
    yaml.dump(scene, out)
    path.write_text(out.getvalue(), encoding='utf-8')
    return path


def _labels(bag: Bag, tissue: dict[str, Any], regions: np.ndarray) -> dict[str, Any]:
    """Return the labels of the tetrahedra as cell data: those that the scene gives the regions.

    Args:
        bag: for messages.
        tissue: section of the scene.
        regions: of the keyframe, 0 or the place in the scene's list from 1; (0,): none.
    """
    if not len(regions):
        return {}
    listed = tissue.get('regions')
    try:
        named = [int(region['label']) for region in listed or ()]
    except (TypeError, KeyError, ValueError):
        raise BagError(f'tissue.regions in the scene of {bag.path} is no list of labels') from None
    if regions.max() > len(named):
        raise BagError(
            f'{bag.path} has a mesh of {regions.max() + 1} regions, and a scene with '
            f'{len(named)} in tissue.regions'
        )
    other = next(label for label in range(len(named) + 1) if label not in named)
    return {'region': [np.array([other, *named])[regions]]}


def recorded_contact(bag: Bag) -> str:
    """Return how the session spread the tool's load; sessions that do not say it had `triangle`."""
    values = _tissue_parameters(bag)
    return str(values.get('contact', 'triangle'))


def planned_method(bag: Bag) -> dict[str, str]:
    """Return keys below `tissue`, in YAML, that set the planned method of the session explicitly.

    They come from the parameters of the simulation; empty where the bag does not have them.
    """
    found = {
        key: str(value)
        for key, value in _tissue_parameters(bag).items()
        if key.partition('.')[0] in ('model', 'integrator', 'active_region')
    }
    return {'method': 'given', **found} if found else {}


def _tissue_parameters(bag: Bag) -> dict[str, Any]:
    """Return the recorded parameters of the simulation, by dotted key."""
    where = f'parameters in the metadata of {bag.path}'
    values = recorded_parameters(bag.custom_data, where).get(f'/{TISSUE_NODE}')
    return dict(text_by_key(values, f'{where}: /{TISSUE_NODE}', nested=True))


def _mapping(yaml: YAML, text: str, where: str) -> dict[str, Any]:
    """Parse a YAML text as a mapping, with its comments."""
    try:
        check_yaml(text)
        found = yaml.load(text)
    except YamlBoundError as error:
        raise BagError(error.of(where)) from None
    except (YAMLError, ValueError) as error:
        raise BagError(f'{where} is not YAML: {" ".join(str(error).split())[:120]}') from None
    if not isinstance(found, dict):
        raise BagError(f'{where} is not a mapping of sections')
    return found


def _translate(scene: dict[str, Any]) -> None:
    """Say in today's keys what scenes of former versions said in others."""
    tissue, haptics = scene['tissue'], scene.get('haptics')
    integration = tissue.get('integration')
    if isinstance(integration, dict) and 'method' in integration:
        tissue.setdefault('integrator', integration.pop('method'))
    if isinstance(haptics, dict):
        haptics.pop('contact', None)
