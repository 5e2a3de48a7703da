"""Table and picture of a session of very many strokes (bench_strokes.py)."""

from dataclasses import dataclass

from matplotlib.figure import Figure
from rich import box as borders
from rich.table import Table

MAX_RATIO = 2.0
"""Limit of frame time and array bytes by live element: those at the end over those of
the beginning."""


@dataclass(frozen=True)
class Row:
    """State of the session after some strokes.

    Attributes:
        strokes, tetrahedra, nodes, triangles: how many there are.
        loose: pieces that no fixed node holds.
        substeps: of a palpated frame.
        median, high: processor time of a palpated frame [ms], and its ninetieth percentile.
        uncut: the same frame of the uncut tissue, measured by turns with it, median [ms].
        by_element: how much more a live element costs than one of the uncut tissue, median over
            frame times that were measured one after the other [-].
        stroke, worst: frames of the strokes since the row before, cutting included, median and
            largest [ms].
        arrays: all of tissue and cutting [bytes].
        resident: memory of the process, the uncut tissue's included [bytes].
        troubles: frames since the row before that the guard mended or took back.
        added: mass that the tissue is moved with beyond its own, as a share of it [-].
    """

    strokes: int
    tetrahedra: int
    nodes: int
    triangles: int
    loose: int
    substeps: int
    median: float
    high: float
    uncut: float
    by_element: float
    stroke: float
    worst: float
    arrays: int
    resident: int
    troubles: int
    added: float


def ratios(rows: list[Row]) -> tuple[float, float]:
    """Return frame time and arrays by live element at the end, over those of the beginning [-]."""
    first, last = rows[0], rows[-1]
    arrays = last.arrays / last.tetrahedra / (first.arrays / first.tetrahedra)
    return last.by_element / first.by_element, arrays


def table(rows: list[Row]) -> Table:
    """Return a line for each state of the session."""
    made = Table(title='Session of strokes', box=borders.SIMPLE_HEAD, title_justify='left')
    heads = (
        'strokes', 'tetrahedra', 'triangles', 'loose', 'substeps', 'frame [ms]', 'p90',
        'by element', 'stroke [ms]', 'worst', 'arrays [MB]', 'process [MB]', 'troubles',
    )  # fmt: skip
    for head in heads:
        made.add_column(head, justify='right')
    for row in rows:
        made.add_row(
            *(
                f'{n}'
                for n in (row.strokes, row.tetrahedra, row.triangles, row.loose, row.substeps)
            ),
            *(f'{x:.3g}' for x in (row.median, row.high, row.by_element, row.stroke, row.worst)),
            *(f'{1e-6 * x:.3g}' for x in (row.arrays, row.resident)),
            f'{row.troubles}',
        )
    return made


def picture(rows: list[Row]) -> Figure:
    """Return frame time and memory by live element over the strokes, both over the beginning."""
    figure = Figure(figsize=(7, 4))
    axes = figure.add_subplot()
    strokes, first = [row.strokes for row in rows], rows[0]
    share = [row.tetrahedra / first.tetrahedra for row in rows]
    lines = {
        'frame time by live element': [row.by_element / first.by_element for row in rows],
        'arrays by live element': [
            row.arrays / first.arrays / much for row, much in zip(rows, share, strict=True)
        ],
        'live elements': share,
        'substeps a frame': [row.substeps / first.substeps for row in rows],
    }
    for name, values in lines.items():
        axes.plot(strokes, values, marker='o', ms=3, label=name)
    axes.axhline(MAX_RATIO, color='grey', lw=0.8, ls='--')
    axes.set_ylim(bottom=0)
    axes.set_xlabel('strokes')
    axes.set_ylabel('over the beginning [-]')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
