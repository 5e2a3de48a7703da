"""Which test files are most likely to find a fault in a module."""

import ast
import re
from functools import cache
from pathlib import Path

from bench.faults.candidates import Fault

_FAR = 9


def likely_tests(root: Path, fault: Fault) -> list[str]:
    """Return all test files, those first that name the function or import its module.

    An import counts by its distance; a word of the module's path in the name of the test file,
    and the function's name in its text, bring it forward.
    """
    graph = import_graph(root)
    names = set(re.findall(r'\w+', fault.function)) - {'__init__'}
    words = set(re.split(r'[/_.]', fault.path)) - {'py', 'sim', 'common'}
    ranked = []
    for path in sorted((root / 'test').glob('test_*.py')):
        text = path.read_text()
        near = distance(graph, f'test/{path.name}', fault.path)
        named = sum(bool(re.search(rf'\b{name}\b', text)) for name in names)
        shared = len(words & set(path.stem.split('_')))
        ranked.append((near - 2 * named - shared, f'test/{path.name}'))
    return [name for _, name in sorted(ranked)]


@cache
def import_graph(root: Path) -> dict[str, set[str]]:
    """Return, by file of product and tests, the files that it imports."""
    files = {
        str(path.relative_to(root))
        for folder in (
            *(p.name for p in (root / 'cutting_trainer').iterdir() if p.is_dir()),
            'test',
        )
        for path in (root / folder).rglob('*.py')
    }
    return {file: imported_files(root / file, files) for file in files}


def imported_files(path: Path, files: set[str]) -> set[str]:
    """Return which of the files one file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        modules = []
        if isinstance(node, ast.ImportFrom) and node.module:
            modules = [node.module, *(f'{node.module}.{alias.name}' for alias in node.names)]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        for module in modules:
            file = module.removeprefix('cutting_trainer.').replace('.', '/')
            found |= {f'{file}.py', f'{file}/__init__.py', f'test/{file}.py'} & files
    return found


def distance(graph: dict[str, set[str]], start: str, end: str) -> int:
    """Return the number of imports from one file to another; many where there is no way."""
    seen, front = {start}, {start}
    for steps in range(1, _FAR):
        front = {file for module in front for file in graph.get(module, ())} - seen
        if end in front:
            return steps
        seen |= front
    return _FAR


def affected_functions(sources: dict[str, str], function: str) -> dict[str, set[str]]:
    """Return, by file, a function and all that name it, or name one that does; also by a constant.

    Args:
        sources: text by file.
        function: name of the changed one.
    """
    named = [
        (file, name, set(re.findall(r'\w+', ast.unparse(statement))))
        for file, source in sources.items()
        for statement in ast.parse(source).body
        for name in defined_names(statement)
    ]
    affected, count = {function}, 0
    while count < len(affected):
        count = len(affected)
        affected |= {name for _, name, words in named if words & affected}
    return {file: {name for f, name, _ in named if f == file} & affected for file in sources}


def defined_names(statement: ast.stmt) -> list[str]:
    """Return the names that a statement of a module defines: of a function, or of constants."""
    if isinstance(statement, ast.FunctionDef):
        return [statement.name]
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    return [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
