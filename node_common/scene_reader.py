"""Scene files: YAML in, checked models out, and errors that state the remedy.

A scene has one section for each folder that reads one; a folder describes its section by a model
derived from `SceneModel` and reads it with `read_section`. YAML 1.2 applies: `1e-3` is a number,
`yes` and `on` are words.
"""

import functools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, ValidationInfo
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from cutting_trainer.node_common.error_place import (
    SectionPlace,
    child_of,
    dotted,
    kind_of,
    line_of,
    most_helpful,
    nearest,
    shortened,
)
from cutting_trainer.node_common.errors import SceneError
from cutting_trainer.node_common.rejections import MAX_TOOLS
from cutting_trainer.node_common.yaml_bounds import YamlBoundError, check_events, read_bounded

SECTIONS = ('tissue', 'tool', 'device', 'haptics', 'cutting', 'arm', 'session', 'exercise')
TOOLS = 'tools'
"""Section of the further tools in the tissue, by the namespace of their bridge and arm. The keys of
each replace those of the sections of the first tool."""
OF_A_TOOL = ('tool', 'device', 'haptics', 'arm')
"""Sections that a further tool may change."""
_TOOL_NAME = re.compile(r'(?!.*__)[a-z][a-z0-9_]{0,31}')
_TAKEN = (
    *('tissue', 'tool', 'arm', 'cutting', 'viewer', 'recorder', 'replay', 'diagnostics'),
    *('haptic_bridge', 'emulated_arm', 'tissue_sim', 'tf_static', 'rosout', 'parameter_events'),
)
"""Names of nodes and topics, which a namespace would be confused with."""


class SceneModel(BaseModel):
    """Base of all models of a scene file: no unknown keys, no NaN, immutable."""

    model_config = ConfigDict(
        extra='forbid', frozen=True, allow_inf_nan=False, validate_default=True
    )


M = TypeVar('M', bound=BaseModel)


def _existing_file(path: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get('folder')
    if folder is not None and not path.is_absolute():
        path = (folder / path).resolve()
    if not path.is_file():
        raise ValueError(missing_file(path))
    return path


ScenePath = Annotated[Path, AfterValidator(_existing_file)]
"""Path of an existing file; in a scene it is relative to the scene file."""


def read_section(path: Path, section: str, model: type[M], tool: str = '') -> M:
    """Read and check one section of a scene file.

    A missing or empty section has the defaults of its model.

    Args:
        path: the scene file.
        section: one of `SECTIONS`.
        model: model of the section, preferably derived from `SceneModel`.
        tool: name of a further tool, with its own keys in place of the first one's; '': the first.

    Raises:
        SceneError: one sentence with file, line, key, value and remedy.
    """
    root, document = _read(path)
    if tool:
        root, document = _as_of_tool(root, document, path, section, tool)
    content = document.get(section)
    try:
        return model.model_validate_json(
            json.dumps({} if content is None else content, default=str),
            strict=True,
            context={'folder': path.parent.resolve()},
        )
    except ValidationError as error:
        if content is None:
            raise SceneError(_missing_section(path, section, error)) from None
        place = SectionPlace(path, section, child_of(root, section) or root, model)
        raise SceneError(most_helpful(place, error.errors())) from None


def read_document(
    path: Path,
    model: type[M],
    kind: str,
    wrong: Callable[[M], list[ErrorDetails]] = lambda document: [],
) -> M:
    """Read and check a whole file of another kind than a scene, by one model.

    Args:
        path: the file.
        model: model of the file, preferably derived from `SceneModel`.
        kind: name of its kind for messages, as in `study`.
        wrong: returns errors that the types of the model cannot express.

    Raises:
        SceneError: one sentence with file, line, key, value and remedy.
    """
    root, document = _read(path, kind, tuple(model.model_fields))
    place = SectionPlace(path, '', root, model)
    try:
        checked = model.model_validate_json(
            json.dumps(document, default=str),
            strict=True,
            context={'folder': path.parent.resolve()},
        )
    except ValidationError as error:
        raise SceneError(most_helpful(place, error.errors())) from None
    if errors := wrong(checked):
        raise SceneError(most_helpful(place, errors))
    return checked


def tool_names(path: Path) -> tuple[str, ...]:
    """Return the names of the further tools of a scene, in their order; (): it has one tool.

    Raises:
        SceneError: one sentence with file, line, key, value and remedy.
    """
    root, _ = _read(path)
    return tuple(str(key.value) for key, _ in _pairs(child_of(root, TOOLS)))


def _as_of_tool(
    root: MappingNode, document: dict[str, Any], path: Path, section: str, tool: str
) -> tuple[MappingNode, dict[str, Any]]:
    """Return a scene with one section as a further tool has it."""
    names = list(document.get(TOOLS) or {})
    if tool not in names:
        known = ', '.join(names) or 'none'
        raise SceneError(f'{path}: section {TOOLS} has no {tool!r:.60}: known are {known}')
    own = child_of(root, TOOLS)
    changes = None if own is None else child_of(own, tool)
    pairs = _pairs(None if changes is None else child_of(changes, section))
    if not pairs:
        return root, document
    before = child_of(root, section)
    changed = {str(key.value) for key, _ in pairs}
    kept = [(k, v) for k, v in _pairs(before) if str(k.value) not in changed]
    made = MappingNode('tag:yaml.org,2002:map', [*kept, *pairs], pairs[0][0].start_mark)
    others = [(k, v) for k, v in root.value if str(k.value) != section]
    key = ScalarNode('tag:yaml.org,2002:str', section, pairs[0][0].start_mark)
    merged = MappingNode(root.tag, [*others, (key, made)], root.start_mark)
    return merged, document | {section: _plain(made, path, (section,))}


def _pairs(node: Node | None) -> list[tuple[Node, Node]]:
    """Return the keys and values of a mapping; [] of what is none, as an empty section."""
    return list(node.value) if isinstance(node, MappingNode) else []


def missing_file(path: Path) -> str:
    """Return a sentence about a missing file, with the most similar name in its folder."""
    if path.is_dir():
        return f'{path} is a folder: name the file in it'
    if not path.parent.is_dir():
        return f'{path} does not exist, nor does its folder {path.parent}: check the path'
    alike = (e.name for e in path.parent.iterdir() if e.suffix == path.suffix and e.is_file())
    near = nearest(path.name, alike)
    return f'{path} does not exist: ' + (f'did you mean {near}?' if near else 'check the path')


def _read(
    path: Path, kind: str = 'scene', known: tuple[str, ...] = SECTIONS
) -> tuple[MappingNode, dict[str, Any]]:
    """Return the nodes and the plain values of a file of a kind, whose sections are known."""
    if not path.is_file():
        raise SceneError(f'{kind} file {missing_file(path)}')
    try:
        return _parsed(path, read_bounded(path), kind, known)
    except YamlBoundError as error:
        raise SceneError(error.of(path)) from None
    except UnicodeDecodeError as error:
        raise SceneError(
            f'{path}: byte {error.start} is not UTF-8 text: a {kind} is a YAML file'
        ) from None
    except OSError as error:
        raise SceneError(f'{path} cannot be read: {error.strerror}') from None
    except YAMLError as error:
        raise SceneError(syntax_error(path, error)) from None


@functools.lru_cache(maxsize=8)  # a scene is read once for each of its sections
def _parsed(
    path: Path, text: str, kind: str, known: tuple[str, ...]
) -> tuple[MappingNode, dict[str, Any]]:
    """Return the nodes and the plain values of the text of a file; nobody changes them."""
    check_yaml(text)
    root = YAML(typ='safe', pure=True).compose(text)
    expected = f'a {kind} is a mapping of the sections {", ".join(known)}'
    if root is None:
        raise SceneError(f'{path} is empty: {expected}')
    if not isinstance(root, MappingNode):
        raise SceneError(f'{path}:{line_of(root)}: the file is a {kind_of(root)}: {expected}')
    document = _plain(root, path, ())
    if kind == 'scene':
        _check_sections(root, path)
    return root, document


def bounded_yaml(path: Path) -> str:
    """Return the text of a YAML file after a check that its number of values is bounded.

    Raises:
        YamlBoundError: it is too large, too deep, or repeats too much by aliases.
        YAMLError, OSError, UnicodeDecodeError: it cannot be read.
    """
    text = read_bounded(path)
    check_yaml(text)
    return text


def check_yaml(text: str) -> None:
    """Refuse YAML with too many values, too deep nesting, or values that contain themselves.

    Raises:
        YamlBoundError: the bound and the line.
        YAMLError: it is not YAML.
    """
    check_events(YAML(typ='safe', pure=True).parse(text))


def syntax_error(path: Path, error: YAMLError) -> str:
    """Return a sentence about invalid YAML, with its place and the likely causes."""
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        reason = ' '.join(str(part) for part in (error.context, error.problem) if part)
        return (
            f'{path}:{mark.line + 1}: not valid YAML at column {mark.column + 1}: {reason}; '
            'check indentation, colons, quotes and brackets here and in the line above'
        )
    reason = ' '.join(str(error).split())
    return f'{path}: not valid YAML: {reason}; save it as plain text without control characters'


def _plain(node: Node, path: Path, keys: tuple[str, ...], above: tuple[Node, ...] = ()) -> Any:
    """Return the plain values of a node tree.

    Values that would be lost or ambiguous are refused.
    """
    where = f'{path}:{line_of(node)}: {dotted(keys) or "the file"}'
    if any(node is parent for parent in above):
        raise SceneError(f'{where} contains itself by an alias: write the values out')
    above = (*above, node)
    if isinstance(node, MappingNode):
        values: dict[str, Any] = {}
        lines: dict[str, int] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, ScalarNode):
                raise SceneError(
                    f'{path}:{line_of(key_node)}: a key is a {kind_of(key_node)}: keys are words'
                )
            key = str(key_node.value)
            if key in values:
                raise SceneError(
                    f'{path}:{line_of(key_node)}: {dotted((*keys, key))} is given twice, first in '
                    f'line {lines[key]}: delete one of them'
                )
            values[key] = _plain(value_node, path, (*keys, key), above)
            lines[key] = line_of(key_node)
        return values
    if isinstance(node, SequenceNode):
        return [_plain(n, path, (*keys, str(i)), above) for i, n in enumerate(node.value)]
    try:
        return YAML(typ='safe', pure=True).constructor.construct_object(node)
    except (YAMLError, ValueError):
        raise SceneError(
            f'{where}: {shortened(node.value)} with the tag {node.tag} cannot be read: '
            'write a plain number or word without a tag'
        ) from None


def _check_sections(root: MappingNode, path: Path) -> None:
    for key_node, value_node in root.value:
        section, known = str(key_node.value), (*SECTIONS, TOOLS)
        if section not in known:
            near = nearest(section, known)
            hint = f'did you mean {near}?' if near else f'known are {", ".join(known)}'
            raise SceneError(f'{path}:{line_of(key_node)}: {section} is not a section: {hint}')
        if not _is_empty(value_node) and not isinstance(value_node, MappingNode):
            raise SceneError(
                f'{path}:{line_of(value_node)}: section {section} is a {kind_of(value_node)}: '
                'it must be a mapping of keys to values'
            )
        if section == TOOLS:
            _check_tools(value_node, path)


def _check_tools(node: Node, path: Path) -> None:
    """Refuse further tools whose names or sections no session could have."""
    tools = _pairs(node)
    if len(tools) >= MAX_TOOLS:
        raise SceneError(
            f'{path}:{line_of(node)}: {TOOLS} has {len(tools)} further tools: at most '
            f'{MAX_TOOLS - 1} fit beside the first'
        )
    for name_node, content in tools:
        name, where = str(name_node.value), f'{path}:{line_of(name_node)}: {TOOLS}'
        if not _TOOL_NAME.fullmatch(name):
            raise SceneError(
                f'{where} has {shortened(name)}: a tool is named by a ROS namespace, '
                'such as grasper: lower-case letters, digits and single underscores'
            )
        if name in _TAKEN:
            raise SceneError(f'{where}.{name}: a topic or node has this name: choose another')
        if not isinstance(content, MappingNode) and not _is_empty(content):
            raise SceneError(
                f'{where}.{name} is a {kind_of(content)}: it must be a mapping of the sections '
                f'{", ".join(OF_A_TOOL)}'
            )
        for key, value in _pairs(content):
            section = str(key.value)
            where = f'{path}:{line_of(key)}: {TOOLS}.{name}.{section}'
            if section not in OF_A_TOOL:
                near = nearest(section, OF_A_TOOL)
                hint = f'did you mean {near}?' if near else f'known are {", ".join(OF_A_TOOL)}'
                raise SceneError(f'{where} is not a section of a tool: {hint}')
            if not isinstance(value, MappingNode) and not _is_empty(value):
                raise SceneError(
                    f'{where} is a {kind_of(value)}: it must be a mapping of keys to values'
                )


def _is_empty(node: Node) -> bool:
    return isinstance(node, ScalarNode) and str(node.tag).endswith(':null')


def _missing_section(path: Path, section: str, error: ValidationError) -> str:
    needed = ', '.join(dotted(e['loc']) for e in error.errors() if e['type'] == 'missing')
    return f'{path}: section {section} is missing' + (f': it needs {needed}' if needed else '')
