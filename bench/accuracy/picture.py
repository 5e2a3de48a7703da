"""One panel of the chart as a picture."""

import math
import textwrap
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.accuracy.measure import Point

_COLOURS = {
    'linear': '#4477aa',
    'linear_smoothed': '#66ccee',
    'corotational': '#cc6677',
    'corotational_smoothed': '#882255',
    'stiffening': '#228833',
}
_PEERS = '#777777', '#aa8866'
_LINE = 11.0
"""Distance of names from each other [pt]."""
_REGIONS = {'off': 'o', 'on': '^', 'budget': 's'}
_JOINED = 'front: nothing is\ncheaper and nearer'
_MARKERS = {'euler': 'v', 'symplectic_euler': 'o', 'rk4': 's', 'implicit': 'D'}


def draw(
    title: str,
    reference: str,
    points: list[Point],
    sentence: str,
    thesis: tuple[str, str],
    default: tuple[str, str],
    peers: Mapping[str, list[Point]] | None = None,
) -> Figure:
    """Return errors against CPU time, both logarithmic: a curve for each model, and the thesis's.

    Args:
        title: of the problem.
        reference: name of the reference.
        points: of the problem.
        sentence: caption.
        thesis, default: model and integrator; the first has a curve of its own, the second rings.
        peers: curves of other packages, by name: two at most.
    """
    figure, axes = _panel(title, reference, sentence)
    _join(axes, points)
    curves: list[tuple[str, str, list[Point]]] = []
    for model, colour in _COLOURS.items():
        own = [p for p in points if p.model == model]
        for integrator, marker in _MARKERS.items():
            axes.plot(
                *_curve([p for p in own if p.integrator == integrator]), marker, color=colour,
                ms=5, alpha=0.3,
            )  # fmt: skip
        chosen = _line_of(own)
        if chosen:
            curves.append((f'{model}, {chosen[0].integrator}', colour, chosen))
    line = [p for p in points if (p.model, p.integrator) == thesis]
    curves.append((f'thesis: {thesis[0]}, {thesis[1]}', 'black', line))
    others = zip((peers or {}).items(), _PEERS, strict=False)
    curves += [(name, colour, own) for (name, own), colour in others]
    for _, colour, own in curves:
        _both_errors(axes, own, colour)
    _mark(axes, points, default, '#ddaa33', 330)
    axes.margins(x=0.12)
    _name(axes, curves)
    axes.legend(handles=_legend(default), fontsize=8, loc='upper left', bbox_to_anchor=(1.01, 1.0))
    return figure


def _line_of(own: list[Point]) -> list[Point]:
    """Return the points of a model by its cheapest integrator on the finest mesh."""
    if not own:
        return []
    finest = max(p.resolution for p in own)
    best = min((p for p in own if p.resolution == finest), key=lambda p: p.cpu_per_second)
    return [p for p in own if p.integrator == best.integrator]


def _curve(own: list[Point]) -> tuple[list[float], list[float]]:
    own = sorted(own, key=lambda p: (p.resolution, p.cpu_per_second))
    return [p.cpu_per_second for p in own], [100 * p.displacement_error for p in own]


def _both_errors(axes: Any, own: list[Point], colour: str) -> None:
    """Draw a curve of the displacement's error, and dashed that of the force's."""
    times, errors = _curve(own)
    axes.plot(times, errors, '-', color=colour, lw=1.8)
    by_mesh = sorted(own, key=lambda p: (p.resolution, p.cpu_per_second))
    axes.plot(times, [100 * p.force_error for p in by_mesh], '--', color=colour, lw=0.9)


def _name(axes: Any, curves: list[tuple[str, str, list[Point]]]) -> None:
    """Write the name of each curve at its end, none over another."""
    ends = [
        (axes.transData.transform((times[-1], errors[-1]))[1], times[-1], errors[-1], name, colour)
        for name, colour, own in curves
        for times, errors in [_curve(own)]
        if own
    ]
    points_a_pixel = 72 / axes.figure.dpi
    last = -math.inf
    for pixel, x, y, name, colour in sorted(ends):
        place = max(pixel * points_a_pixel, last + _LINE)
        up = place - pixel * points_a_pixel
        axes.annotate(
            name, (x, y), xytext=(9, up), textcoords='offset points', color=colour, fontsize=8,
            arrowprops={'arrowstyle': '-', 'color': colour, 'lw': 0.4},
        )  # fmt: skip
        last = place


def draw_regions(
    title: str, reference: str, points: list[Point], sentence: str, default: str
) -> Figure:
    """Return the same for active regions: a line and a front by mesh, a symbol by region.

    Args:
        title, reference, points, sentence: as for `draw`.
        default: region that is marked.
    """
    figure, axes = _panel(title, reference, sentence)
    entries = []
    for resolution, colour in zip(
        sorted({p.resolution for p in points}), _COLOURS.values(), strict=False
    ):
        mesh = [p for p in points if p.resolution == resolution]
        _join(axes, mesh)
        for kind, marker in _REGIONS.items():
            own = [p for p in mesh if p.region.split()[0] == kind]
            own.sort(key=lambda p: p.displacement_error)
            axes.plot(
                [p.cpu_per_second for p in own],
                [100 * p.displacement_error for p in own],
                marker=marker, color=colour, lw=0.7, ms=7, alpha=0.85,
            )  # fmt: skip
            for p in own:
                axes.annotate(
                    p.region, (p.cpu_per_second, 100 * p.displacement_error), fontsize=7,
                    xytext=(6, 2), textcoords='offset points', color='0.3',
                )  # fmt: skip
        label = f'{mesh[0].tetrahedra} tetrahedra'
        entries.append(Line2D([], [], color=colour, lw=3, label=label))
    _ring(axes, [p for p in points if p.region == default], '#ddaa33', 330)
    entries += [
        Line2D([], [], color='0.3', marker=m, lw=0, label=text)
        for m, text in zip(
            _REGIONS.values(),
            ('off: all nodes', 'on: tolerance [m/s]', 'budget: nodes'),
            strict=True,
        )
    ]
    ring = Line2D([], [], color='#ddaa33', marker='o', lw=0, ms=12, mfc='none', mew=1.8)
    ring.set_label(f'default: {default}')
    joined = Line2D([], [], color='0.75', lw=5, label=_JOINED)
    axes.legend(handles=[*entries, ring, joined], fontsize=8, loc='upper left',
                bbox_to_anchor=(1.01, 1.0))  # fmt: skip
    return figure


def _join(axes: Any, points: list[Point]) -> None:
    """Draw a line through the points on the front, behind everything."""
    front = sorted((p for p in points if p.front), key=lambda p: p.cpu_per_second)
    axes.plot(
        [p.cpu_per_second for p in front],
        [100 * p.displacement_error for p in front],
        color='0.75',
        lw=5,
        zorder=0,
        solid_capstyle='round',
    )


def _panel(title: str, reference: str, sentence: str) -> tuple[Figure, Any]:
    """Return axes, and the sentence under them."""
    figure = Figure(figsize=(9.0, 6.4), layout='constrained')
    axes = figure.subplots()
    axes.axvline(1.0, color='0.4', lw=0.8, ls='--')
    axes.annotate(
        'real time on one core', (1.0, 0.02), xycoords=('data', 'axes fraction'), rotation=90,
        ha='right', va='bottom', fontsize=8, color='0.3',
    )  # fmt: skip
    axes.set(xscale='log', yscale='log', title=title)
    axes.set_xlabel('CPU time for one second of simulated time [s/s]')
    axes.set_ylabel(f'error [%]\nagainst {reference}', fontsize=9)
    axes.grid(which='both', lw=0.3, alpha=0.5)
    figure.supxlabel('\n'.join(textwrap.wrap(sentence, 118)), fontsize=9, x=0.02, ha='left')
    return figure, axes


def _mark(
    axes: Any, points: list[Point], method: tuple[str, str], colour: str, size: float
) -> None:
    _ring(axes, [p for p in points if (p.model, p.integrator) == method], colour, size)


def _ring(axes: Any, own: list[Point], colour: str, size: float) -> None:
    axes.scatter(
        [p.cpu_per_second for p in own],
        [100 * p.displacement_error for p in own],
        s=size,
        facecolors='none',
        edgecolors=colour,
        linewidths=1.8,
        zorder=3,
    )


def _legend(default: tuple[str, str]) -> list[Line2D]:
    entries = [
        Line2D(
            [], [], color='0.3', lw=1.8, label='of the displacement, by the\ncheapest integrator'
        ),
        Line2D([], [], color='0.3', lw=0.9, ls='--', label='of the force'),
    ]
    entries += [
        Line2D([], [], color='0.3', marker=m, lw=0, alpha=0.5, label=f'faint: {name}')
        for name, m in _MARKERS.items()
    ]
    label = f'default: {default[0]}\nby {default[1]}'
    entries.append(
        Line2D([], [], color='#ddaa33', marker='o', lw=0, ms=12, mfc='none', mew=1.8, label=label)
    )
    entries.append(Line2D([], [], color='0.75', lw=5, label=_JOINED))
    return entries
