"""The table at the end of a session."""

import math
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from cutting_trainer.session.summary import NodeSummary, Summary

_STYLE: dict[str, Any] = {'box': box.SIMPLE_HEAD, 'pad_edge': False, 'collapse_padding': True}


def session_tables(summary: Summary) -> RenderableType:
    """Return a table of the nodes and a table of the session."""
    nodes = Table(title='Nodes', **_STYLE)
    nodes.add_column('node', no_wrap=True)
    for column in (
        'rate [Hz]\n/ lowest',
        'in time\n[%]',
        'period p99\n/ worst [ms]',
        'late p99.9\n[ms]',
        'missed',
    ):
        nodes.add_column(column, justify='right', no_wrap=True)
    nodes.add_column('real\ntime', no_wrap=True)
    for node in summary.nodes.values():
        nodes.add_row(*_cells(node))
    session = Table(title='Session', show_header=False, **_STYLE)
    session.add_column(style='bold')
    session.add_column(overflow='fold')
    for name, text in _rows(summary):
        session.add_row(name, escape(text))
    return Group(nodes, session)


def _cells(node: NodeSummary) -> tuple[str, ...]:
    if math.isnan(node.rate):
        return (node.name, 'on demand', '', '', '', '', '')
    return (
        node.name,
        _pair(node.rate, node.lowest_rate),
        _number(node.within, 100.0),
        _pair(node.period_p99, node.worst_period_p99, 1e3),
        _number(node.lateness_p999, 1e3),
        _number(node.missed, digits=9),
        '' if not node.real_time else ('yes' if node.has_real_time else 'no'),
    )


def _rows(summary: Summary) -> list[tuple[str, str]]:
    lost = ', '.join(f'{count} of {topic}' for topic, count in summary.lost.items())
    missed = sum(summary.missed.values())
    rows = [
        ('duration', f'{summary.duration:.1f} s'),
        ('contact', f'{summary.contact_time:.1f} s'),
        ('largest force', f'{summary.largest_force:.2f} N'),
        ('elements cut', str(summary.elements_cut)),
        ('messages recorded', str(summary.messages)),
        ('messages lost', (lost or '0') + ('' if summary.complete else ' before the bag ends')),
    ]
    if missed:
        rows.append(('sent before recording', str(missed)))
    refused = {n.real_time for n in summary.nodes.values() if n.real_time and not n.has_real_time}
    rows += [('note', sentence) for sentence in sorted(refused)]
    return [*rows, ('bag', summary.bag)]


def _number(value: float, scale: float = 1.0, digits: int = 4) -> str:
    return '' if math.isnan(value) else f'{value * scale:.{digits}g}'


def _pair(usual: float, worst: float, scale: float = 1.0) -> str:
    return '' if math.isnan(usual) else f'{_number(usual, scale)} / {_number(worst, scale)}'
