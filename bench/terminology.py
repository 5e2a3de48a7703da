"""Check the words of the source: names that a standard term replaces, and style of docstrings."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = (
    'node_common',
    'tissue_sim',
    'haptic_bridge',
    'cutting',
    'bags',
    'exercises',
    'viewer',
    'session',
    'recordings',
    'studies',
    'mesh_import',
    'cli',
    'bench',
)
REPLACED = {
    'patience': 'timeout_s',
    'limp': 'max_compliance',
    'breath': 'yield_s',
    'keeper': 'mesh recovery',
    'keepers': 'mesh recovery',
    'rings': 'adjacency',
    'lips': 'cut faces',
    'unheard': 'missed before subscription',
}
"""Words that names must not have, and the standard term for each."""
BOUNDS = {'MOST': 'MAX', 'LARGEST': 'MAX', 'LONGEST': 'MAX', 'LEAST': 'MIN', 'SMALLEST': 'MIN'}
"""Words that constants must not have, and the term for each."""
WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")
NAME_PART = re.compile(r'[A-Z]+(?![a-z])|[A-Z]?[a-z]+')
ALLOWED = frozenset({'most_common', 'EStopKeeper'})


@functools.cache
def sources() -> list[tuple[Path, list[ast.AST]]]:
    """Return the path and the syntax nodes of each module of the product and of bench."""
    return [
        (path, list(ast.walk(ast.parse(path.read_text(encoding='utf-8')))))
        for room in ROOMS
        for path in sorted((ROOT / room).rglob('*.py'))
    ]


def names(nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Yield the line and the name of everything that a module defines."""
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id


def replaced_names() -> list[str]:
    """Return a sentence for each defined name that has a word of `REPLACED`."""
    found = []
    for path, nodes in sources():
        for line, name in names(nodes):
            if name in ALLOWED:
                continue
            for part in NAME_PART.findall(name):
                term = REPLACED.get(part.lower()) or (BOUNDS.get(part) if part.isupper() else None)
                if term:
                    place = f'{path.relative_to(ROOT)}:{line}'
                    found.append(f'{place}: {name!r} says {part!r}: the term is {term!r}')
    return found


def docstrings() -> Iterator[tuple[str, ast.AST, str]]:
    """Yield the place, the node and the text of each docstring."""
    for path, nodes in sources():
        for node in nodes:
            if isinstance(
                node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
            ) and (text := ast.get_docstring(node)):
                yield f'{path.relative_to(ROOT)}:{getattr(node, "lineno", 1)}', node, text


def what_clauses() -> tuple[int, int]:
    """Return how often docstrings say the word, and how many words they have."""
    words = [word.lower() for _, _, text in docstrings() for word in WORD.findall(text)]
    return words.count('what'), len(words)


def summaries_without_verb() -> list[str]:
    """Return the places of functions whose summary does not begin with an imperative verb.

    Properties and context managers are named by nouns, as Google's guide has it.
    """
    found = []
    for place, node, text in docstrings():
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if any(word in ast.unparse(d) for d in node.decorator_list for word in _NOUNS):
            continue
        first = text.split()[0].rstrip('.,:;')
        if first.lower() in _NO_VERBS or (first.endswith('s') and not first.endswith('ss')):
            found.append(f'{place}: {text.partition(chr(10))[0]}')
    return found


_NOUNS = ('property', 'contextmanager', 'fixture', 'overload')
_NO_VERBS = frozenset(
    'the a an what whether how which where why one all those each of by for from in as at'.split()  # noqa: SIM905
)
