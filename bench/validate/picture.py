"""Error against cost of all cases, as one picture."""

from collections.abc import Mapping, Sequence
from statistics import median

from matplotlib.figure import Figure

from bench.validate.case import Result

SHOWN = 'stiffening'
_FALLBACK = 'linear_smoothed'
_COLOURS = ('#4477aa', '#cc6677', '#228833', '#aa3377', '#66ccee', '#ccbb44', '#882255', '#555555')
_MIN_ERROR = 1e-4
"""Error below which a point stands at the lower edge."""


def curve(rows: Sequence[Result], model: str) -> list[tuple[float, float]]:
    """Return CPU time and median error of a model, by mesh."""
    points = []
    for count in sorted({row.tetrahedra for row in rows}):
        own = [row for row in rows if (row.model, row.tetrahedra) == (model, count)]
        errors = [abs(row.error) for row in own if row.error is not None]
        if errors:
            points.append((median(row.cpu for row in own), max(median(errors), _MIN_ERROR)))
    return points


def draw(results: Mapping[str, Sequence[Result]]) -> Figure:
    """Return the picture: a labelled curve for each case, other models as points.

    Args:
        results: by case; the first eight are drawn.
    """
    figure = Figure(figsize=(9.0, 6.0), layout='constrained')
    axes = figure.subplots()
    for (name, rows), colour in zip(results.items(), _COLOURS, strict=False):
        models = {row.model for row in rows}
        main = SHOWN if SHOWN in models else _FALLBACK
        for model in models - {main}:
            other = curve(rows, model)
            axes.plot(*zip(*other, strict=True), 'o', ms=4, color=colour, alpha=0.3) if other else 0
        points = curve(rows, main)
        if not points:
            continue
        axes.plot(*zip(*points, strict=True), 'o-', ms=7, lw=1.6, color=colour)
        axes.annotate(
            f'{name}, {main}', points[-1], xytext=(7, 5), textcoords='offset points',
            color=colour, fontsize=9,
        )  # fmt: skip
    axes.set(xscale='log', yscale='log', title='Published experiments: error against CPU time')
    axes.set_xlabel('CPU time of a result, one thread [s]')
    axes.set_ylabel('median of the errors')
    axes.grid(which='both', lw=0.3, alpha=0.5)
    axes.margins(x=0.25)
    figure.supxlabel('faint: the other elastic models', fontsize=9, x=0.02, ha='left')
    return figure
