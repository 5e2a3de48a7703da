"""Bounded YAML parser for untrusted bags: metadata.yaml and texts inside of it."""

from typing import Any

import yaml

from cutting_trainer.bags.errors import BagError
from cutting_trainer.node_common.yaml_bounds import YamlBoundError, check_events

MAX_BYTES = 1 << 22
"""Bytes of a metadata.yaml; one of a session has 20 kB, scene and parameters included."""
MAX_VALUES = 50_000
"""Values of a metadata.yaml: 200 topics of three publishers each have 15,000."""

_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


def load_yaml(text: str, where: str) -> Any:
    """Return the plain values of a YAML text.

    Args:
        text: YAML 1.1.
        where: file or field that contains it, for the error.

    Raises:
        BagError: it is not YAML, or larger or deeper than that of a bag can be.
    """
    if len(text) > MAX_BYTES:
        raise BagError(f'{where} has {len(text)} characters: {MAX_BYTES} at most')
    try:
        check_events(yaml.parse(text, Loader=_LOADER), MAX_VALUES, complete=True)
        return yaml.load(text, Loader=_LOADER)
    except YamlBoundError as error:
        raise BagError(error.of(where)) from None
    except (yaml.YAMLError, ValueError, TypeError, OverflowError) as error:
        mark = getattr(error, 'problem_mark', None)
        line = f':{mark.line + 1}' if mark is not None else ''
        reason = getattr(error, 'problem', None) or ' '.join(str(error).split())[:120]
        raise BagError(f'{where}{line}: not valid YAML: {reason}') from None


def text_by_key(value: Any, where: str, *, nested: bool = False) -> dict[str, str]:
    """Return a mapping of words to texts, such as `custom_data`.

    Args:
        value: a parsed YAML value.
        where: field that contains it, for the error.
        nested: lists and mappings may be among the values.

    Raises:
        BagError: it is no such mapping.
    """
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise BagError(f'{where} is not a mapping of words to texts')
    wrong = [
        key for key, text in value.items() if not _is_text(key) or not (nested or _is_text(text))
    ]
    if wrong:
        raise BagError(f'{where}: {str(wrong[0])[:60]!r} does not have a text')
    return {str(key): str(text) for key, text in value.items()}


def _is_text(value: Any) -> bool:
    return not isinstance(value, dict | list | set | tuple)
