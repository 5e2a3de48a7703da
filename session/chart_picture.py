"""One panel of the chart as a picture."""

import textwrap
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from session.chart_measure import Point

_COLOURS = {
    'linear': '#4477aa',
    'linear_smoothed': '#66ccee',
    'corotational': '#cc6677',
    'corotational_smoothed': '#882255',
}
_MARKERS = {'euler': 'v', 'symplectic_euler': 'o', 'rk4': 's', 'implicit': 'D'}


def draw(
    title: str,
    reference: str,
    points: list[Point],
    sentence: str,
    thesis: tuple[str, str],
    default: tuple[str, str],
) -> Figure:
    """Error against CPU time, both logarithmic.

    Args:
        title: of the problem.
        reference: what the error is against.
        points: of the problem.
        sentence: what it shows, written under it.
        thesis, default: model and integrator that are marked.
    """
    figure = Figure(figsize=(9.0, 6.4), layout='constrained')
    axes = figure.subplots()
    for model, colour in _COLOURS.items():
        for integrator, marker in _MARKERS.items():
            own = [p for p in points if (p.model, p.integrator) == (model, integrator)]
            own.sort(key=lambda p: (p.resolution, p.cpu_per_second))
            axes.plot(
                [p.cpu_per_second for p in own],
                [100 * p.displacement_error for p in own],
                marker=marker,
                color=colour,
                lw=0.7,
                ms=6,
                alpha=0.85,
                ls='-' if integrator != 'implicit' else ':',
            )
    _mark(axes, points, thesis, 'black', 210)
    _mark(axes, points, default, '#ddaa33', 330)
    front = sorted((p for p in points if p.front), key=lambda p: p.cpu_per_second)
    axes.plot(
        [p.cpu_per_second for p in front],
        [100 * p.displacement_error for p in front],
        color='0.75',
        lw=5,
        zorder=0,
        solid_capstyle='round',
    )
    axes.axvline(1.0, color='0.4', lw=0.8, ls='--')
    axes.annotate(
        'real time on one core', (1.0, 0.02), xycoords=('data', 'axes fraction'), rotation=90,
        ha='right', va='bottom', fontsize=8, color='0.3',
    )  # fmt: skip
    axes.set(xscale='log', yscale='log', title=title)
    axes.set_xlabel('CPU time for one second of simulated time [s/s]')
    axes.set_ylabel(f'error of the displacement [%]\nagainst {reference}', fontsize=9)
    axes.grid(which='both', lw=0.3, alpha=0.5)
    axes.legend(handles=_legend(thesis, default), fontsize=8, loc='upper left',
                bbox_to_anchor=(1.01, 1.0))  # fmt: skip
    figure.supxlabel('\n'.join(textwrap.wrap(sentence, 118)), fontsize=9, x=0.02, ha='left')
    return figure


def _mark(
    axes: Any, points: list[Point], method: tuple[str, str], colour: str, size: float
) -> None:
    own = [p for p in points if (p.model, p.integrator) == method]
    axes.scatter(
        [p.cpu_per_second for p in own],
        [100 * p.displacement_error for p in own],
        s=size,
        facecolors='none',
        edgecolors=colour,
        linewidths=1.8,
        zorder=3,
    )


def _legend(thesis: tuple[str, str], default: tuple[str, str]) -> list[Line2D]:
    entries = [Line2D([], [], color=c, lw=3, label=name) for name, c in _COLOURS.items()]
    entries += [
        Line2D([], [], color='0.3', marker=m, lw=0, label=name) for name, m in _MARKERS.items()
    ]
    for colour, name, method in (('black', 'thesis', thesis), ('#ddaa33', 'default', default)):
        label = f'{name}: {method[0]}\nby {method[1]}'
        ring = Line2D([], [], color=colour, marker='o', lw=0, ms=12, mfc='none', mew=1.8)
        ring.set_label(label)
        entries.append(ring)
    joined = 'front: nothing is\ncheaper and nearer'
    entries.append(Line2D([], [], color='0.75', lw=5, label=joined))
    return entries
