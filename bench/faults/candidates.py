"""Where a small fault can be planted in a function: positions by `ast`, edits of the text.

Left out beforehand, since they change nothing that a test should find: docstrings, annotations,
defaults, the text of errors and logs, warm-ups, and functions that nothing else names.
A comparison of order is turned around unless a side is a whole number: for two measured numbers,
`<` and `<=` are the same.
"""

import ast
import itertools
import random
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

Kind = Literal['sign', 'index', 'off by one', 'comparison', 'dropped call']
KINDS: tuple[Kind, ...] = get_args(Kind)
ROOMS = ('bags', 'cutting', 'haptic_bridge', 'node_common', 'tissue_sim', 'viewer')
"""Folders that have kernels, nodes, or cores that nodes call."""
_LOGS = {'debug', 'info', 'warning', 'warn', 'error', 'fatal', 'exception', 'log', 'print'}
_KERNELS = {'kernel', 'inner'}
_ADDED: dict[type, str] = {ast.Add: '-', ast.Sub: '+'}
_OPPOSITE: dict[type, tuple[str, str]] = {
    ast.Lt: ('<', '>='),
    ast.LtE: ('<=', '>'),
    ast.Gt: ('>', '<='),
    ast.GtE: ('>=', '<'),
    ast.Eq: ('==', '!='),
    ast.NotEq: ('!=', '=='),
    ast.Is: ('is', 'is not'),
    ast.IsNot: ('is not', 'is'),
}
_BOUNDARY = {'<': '<=', '<=': '<', '>': '>=', '>=': '>'}


@dataclass(frozen=True)
class Fault:
    """One edit of one source file.

    Attributes:
        path: of the file, below the root.
        line: first line, from 1.
        column: in that line [bytes].
        function: in which it is, with its class.
        kernel: whether Numba compiles the function.
        kind: of fault.
        old: text that is there.
        new: text instead of it, of as many lines.
    """

    path: str
    line: int
    column: int
    function: str
    kernel: bool
    kind: Kind
    old: str
    new: str

    @property
    def room(self) -> str:
        """Folder of the file."""
        return str(Path(self.path).parent)

    def plant(self, source: str) -> str:
        """Return the source with the fault in it.

        Raises:
            ValueError: the source does not have the old text there.
        """
        data, old = source.encode(), self.old.encode()
        starts = [0, *(match.end() for match in re.finditer(b'\n', data))]
        at = starts[self.line - 1] + self.column if self.line <= len(starts) else len(data)
        if data[at : at + len(old)] != old:
            raise ValueError(f'{self.path}:{self.line} does not have {self.old!r} any more')
        return (data[:at] + self.new.encode() + data[at + len(old) :]).decode()


def find_candidates(root: Path) -> list[Fault]:
    """Return every fault that could be planted in kernels, nodes and the cores that nodes call."""
    sources = {
        str(path.relative_to(root)): path.read_text()
        for room in ROOMS
        for path in sorted((root / room).rglob('*.py'))
        if path.stem != 'warm_up'
    }
    words = Counter(re.findall(r'\w+', '\n'.join(sources.values())))
    called = called_by_nodes(sources)
    found = []
    for path, source in sources.items():
        for name, function in functions(ast.parse(source)):
            kernel = is_kernel(function)
            if (kernel or path in called) and is_alive(function.name, words):
                found += _Finder(path, source, name, kernel).faults(function)
    return found


def draw(root: Path, count: int, seed: int) -> list[Fault]:
    """Return a draw that goes round the kinds, and takes each from the room that had least so far.

    Args:
        root: of the source.
        count: how many.
        seed: of the draw.

    Raises:
        ValueError: there are not so many.
    """
    left, rng = find_candidates(root), random.Random(seed)
    rng.shuffle(left)
    drawn: list[Fault] = []
    rooms = Counter[tuple[str, bool]]()
    kinds = itertools.cycle(KINDS)
    while len(drawn) < count:
        if not left:
            raise ValueError(f'there are {len(drawn)} places for a fault, not {count}')
        kind = next(kinds)
        fitting = [fault for fault in left if fault.kind == kind]
        if fitting:
            fault = min(fitting, key=lambda f: rooms[f.room, f.kernel])
            left.remove(fault)
            if compiles(fault, (root / fault.path).read_text()):
                rooms[fault.room, fault.kernel] += 1
                drawn.append(fault)
    return drawn


def called_by_nodes(sources: dict[str, str]) -> set[str]:
    """Return the node modules, and the modules of their own room or node_common they import."""
    nodes = [path for path in sources if path.endswith('node.py')]
    found = set(nodes)
    for node in nodes:
        for module in re.findall(r'^from cutting_trainer\.([\w.]+) import', sources[node], re.M):
            path = module.replace('.', '/') + '.py'
            if path in sources and path.split('/')[0] in (node.split('/')[0], 'node_common'):
                found.add(path)
    return found


def functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield functions and methods with their names; inner functions belong to them."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node
        elif isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, ast.FunctionDef):
                    yield f'{node.name}.{member.name}', member


def is_kernel(function: ast.FunctionDef) -> bool:
    """Return whether Numba compiles it."""
    decorators = (d.func if isinstance(d, ast.Call) else d for d in function.decorator_list)
    return any(isinstance(d, ast.Name) and d.id in _KERNELS for d in decorators)


def is_alive(name: str, words: Counter[str]) -> bool:
    """Return whether somebody names the function, or ROS calls it; of texts for people, none."""
    if name in ('__repr__', '__str__') or 'warm_up' in name:
        return False
    return words[name] > 1 or name.startswith(('on_', '__'))


def compiles(fault: Fault, source: str) -> bool:
    """Return whether the source with the fault is Python, and another program."""
    try:
        return ast.dump(ast.parse(fault.plant(source))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


class _Finder(ast.NodeVisitor):
    """Collects the faults of one function."""

    def __init__(self, path: str, source: str, function: str, kernel: bool) -> None:
        self._where = path, function, kernel
        self._lines = source.encode().split(b'\n')
        self._index = 0
        self._found: list[Fault] = []

    def faults(self, function: ast.FunctionDef) -> list[Fault]:
        """Return the faults that fit the body of a function."""
        for statement in function.body:
            self.visit(statement)
        return self._found

    # Nodes without a meaning for a test.

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        """Pass by the text of an error."""

    visit_Assert = visit_JoinedStr = visit_Raise  # noqa: N815

    def visit_Call(self, node: ast.Call) -> None:
        name = _name(node.func)
        if name in _LOGS:
            return
        if name == 'range' and node.args:
            stop = node.args[min(1, len(node.args) - 1)]
            self._replace('off by one', stop, f'({self._text(stop)}) - 1')
        if name in ('abs', 'min', 'max') and isinstance(node.func, ast.Name) and node.args:
            self._replace('dropped call', node, f'({self._text(node.args[0])})')
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        call = node.value
        if isinstance(call, ast.Call):
            if _name(call.func) in _LOGS or '__init__' in self._text(call.func):
                return
            self._replace('dropped call', node, 'pass' + '\n' * (_end(node) - node.lineno))
            self.visit(call)

    # The other kinds.

    def visit_BinOp(self, node: ast.BinOp) -> None:
        texts = (ast.JoinedStr, ast.List, ast.Tuple)
        sides = (node.left, node.right)
        plain = not any(
            isinstance(s, texts) or (isinstance(s, ast.Constant) and isinstance(s.value, str))
            for s in sides
        )
        if plain and type(node.op) in _ADDED:
            new = _ADDED[type(node.op)]
            old = '+' if new == '-' else '-'
            self._between('index' if self._index else 'sign', node.left, node.right, old, new)
            for side in sides:
                if _is_one(side) and not self._index:
                    self._replace('off by one', side, '2')
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if type(node.op) in _ADDED and not isinstance(node.value, (ast.JoinedStr, ast.List)):
            new = _ADDED[type(node.op)]
            old = '+' if new == '-' else '-'
            self._between('sign', node.target, node.value, f'{old}=', f'{new}=')
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub) and not self._index:
            self._replace('sign', node, f'({self._text(node.operand)})')
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.visit(node.value)
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        names = [part.id for part in parts if isinstance(part, ast.Name)]
        if len(names) == len(parts) == 2 and names[0] != names[1]:
            self._replace('index', node.slice, f'{names[1]}, {names[0]}')
        for part in parts:
            if isinstance(part, ast.Slice):
                for bound, change in ((part.lower, '+'), (part.upper, '-')):
                    if bound is not None:
                        self._replace('off by one', bound, f'({self._text(bound)}) {change} 1')
            elif isinstance(part, ast.Constant) and type(part.value) is int:
                self._replace('index', part, str(part.value - 1 if part.value else 1))
        self._index += 1
        self.visit(node.slice)
        self._index -= 1

    def visit_Compare(self, node: ast.Compare) -> None:
        if len(node.ops) == 1 and type(node.ops[0]) in _OPPOSITE:
            old, new = _OPPOSITE[type(node.ops[0])]
            right = node.comparators[0]
            if _is_whole(node.left) or _is_whole(right):
                new = _BOUNDARY.get(old, new)
            self._between('comparison', node.left, right, old, new)
        self.generic_visit(node)

    def _text(self, node: ast.AST) -> str:
        return ast.unparse(node)

    def _replace(self, kind: Kind, node: ast.expr | ast.stmt, new: str) -> None:
        first, last = node.lineno - 1, _end(node) - 1
        lines = self._lines[first : last + 1]
        lines[-1] = lines[-1][: node.end_col_offset]
        lines[0] = lines[0][node.col_offset :]
        old = b'\n'.join(lines).decode()
        if old.count('\n') == new.count('\n'):
            self._add(kind, node.lineno, node.col_offset, old, new)

    def _between(self, kind: Kind, left: ast.expr, right: ast.expr, old: str, new: str) -> None:
        """Replace an operator that stands on the line on which the left side ends."""
        if _end(left) != right.lineno:
            return
        start = left.end_col_offset or 0
        text = self._lines[right.lineno - 1][start : right.col_offset].decode()
        if text.strip(' ()') == old:
            self._add(kind, right.lineno, start + text.index(old), old, new)

    def _add(self, kind: Kind, line: int, column: int, old: str, new: str) -> None:
        path, function, kernel = self._where
        self._found.append(Fault(path, line, column, function, kernel, kind, old, new))


def _name(function: ast.expr) -> str:
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ''


def _is_whole(node: ast.expr) -> bool:
    """Return whether it is a whole number, as far as the text says."""
    if isinstance(node, ast.Constant):
        return type(node.value) is int
    return (isinstance(node, ast.Call) and _name(node.func) == 'len') or (
        isinstance(node, ast.Attribute) and node.attr in ('size', 'ndim')
    )


def _is_one(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) is int and node.value == 1


def _end(node: ast.expr | ast.stmt) -> int:
    return node.end_lineno or node.lineno
