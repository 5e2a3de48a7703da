"""Accuracy against cost: the error of the force under each setting, beside its processor time.

The error is the difference to the force under the reference of the study. A setting is on the front
if no other one beats it: none has a smaller error, or the same one, in the same time or less.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cutting_trainer.studies.designs import short_names
from cutting_trainer.studies.effects import interval
from cutting_trainer.studies.table import Row

HEAD = ('setting', 'error [N]', 'share', 'time [s]', 'ratio', 'bags', 'interval [N]')
"""Columns of `cells`."""
NARROW = 6
"""Columns in the terminal."""
MEANING = (
    'error: rms difference of the force to that of the reference; share: of its mean force in '
    'contact; time: of one processor; ratio: to the time of the reference; both are medians over '
    'bags. A star marks a setting that no other one beats: none has a smaller error at the same '
    'ratio or less.'
)
_COLOUR = '#1f4e8c'


@dataclass(frozen=True)
class Tradeoff:
    """Error and cost of a setting.

    Attributes:
        setting: its changes, in a few words.
        error: rms difference of the force to that of the reference, mean over bags [N].
        low, high: confidence interval of the error [N]; NaN with fewer than two bags.
        share: error as a share of the reference's mean force in contact, mean over bags [-].
        time: processor time of a session, median over bags [s].
        ratio: that time over the reference's for the same bag, median over bags [-].
        bags: number of bags.
        is_reference: it is that with which the others are compared.
        on_front: it has all bags of the reference, and no other such setting beats it.
    """

    setting: str
    error: float
    low: float
    high: float
    share: float
    time: float
    ratio: float
    bags: int
    is_reference: bool
    on_front: bool

    @property
    def cells(self) -> tuple[str, ...]:
        """Return the columns of `HEAD`."""
        ends = '' if np.isnan(self.low) else f'{self.low:.2g} to {self.high:.2g}'
        mark = ' (reference)' if self.is_reference else ' *' if self.on_front else ''
        return (
            f'{self.setting}{mark}',
            f'{self.error:.3g}',
            '' if np.isnan(self.share) else f'{self.share:.1%}',
            f'{self.time:.2f}',
            f'{self.ratio:.2f}',
            str(self.bags),
            ends,
        )


def tradeoffs(rows: Sequence[Row], confidence: float) -> list[Tradeoff]:
    """Return error and cost of each setting, the cheapest first; none for a study without a
    reference.

    Args:
        rows: of the study; failures are left out with their bags.
        confidence: level of the intervals.
    """
    done: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.setting.number and not row.result.failure:
            done.setdefault(row.setting.identity, {})[row.bag.hash] = row
    best = {r.bag.hash: r for r in rows if r.is_reference and not r.result.failure}
    names = short_names(
        dict.fromkeys(
            key for of in done.values() for row in of.values() for key in row.setting.changes
        )
    )
    found = []
    for of_setting in done.values():
        pairs = [(row, best[bag]) for bag, row in of_setting.items() if bag in best]
        if not pairs:
            continue
        errors = np.array([row.result.outputs['force_rms_difference'] for row, _ in pairs])
        forces = np.array([ref.result.outputs['mean_force_in_contact'] for _, ref in pairs])
        times = np.array([[row.result.cpu, ref.result.cpu] for row, ref in pairs])
        touched = forces > 0.0
        mean, low, high = interval(errors, confidence)
        found.append(
            Tradeoff(
                setting=pairs[0][0].setting.label(names),
                error=mean,
                low=low,
                high=high,
                share=float((errors[touched] / forces[touched]).mean())
                if touched.any()
                else np.nan,
                time=float(np.median(times[:, 0])),
                ratio=float(np.median(times[:, 0] / times[:, 1])),
                bags=len(pairs),
                is_reference=pairs[0][0].is_reference,
                on_front=False,
            )
        )
    return _with_front(found, len(best))


def _with_front(found: Sequence[Tradeoff], bags: int) -> list[Tradeoff]:
    """Return settings the cheapest first, with those on the front marked; it has all bags."""
    least, marked = np.inf, []
    for one in sorted(found, key=lambda one: (one.ratio, one.error)):
        whole = one.bags == bags
        marked.append(replace(one, on_front=whole and one.error < least))
        least = min(least, one.error) if whole else least
    return marked


def tradeoff_figure(found: Sequence[Tradeoff]) -> Figure | None:
    """Return a plot of error over cost, with the numbers of the table; None: there is no error."""
    shown = [(str(n), one) for n, one in enumerate(found, start=1) if one.error > 0.0]
    if not shown:
        return None
    figure = Figure(figsize=(8.0, 4.5), layout='constrained')
    axes: Any = figure.subplots()
    front = np.array([(one.ratio, one.error) for _, one in shown if one.on_front])
    axes.step(*front.reshape(-1, 2).T, where='post', color=_COLOUR, lw=0.8)
    for number, one in shown:
        at, fill = (one.ratio, one.error), 'full' if one.on_front else 'none'
        axes.plot(*at, 'o', ms=5, color=_COLOUR, fillstyle=fill)
        axes.annotate(number, at, xytext=(5, 4), textcoords='offset points', fontsize=9)
    axes.set(
        xlabel='processor time, as a share of the reference',
        ylabel='error of the force, rms [N]',
        yscale='log',
    )
    axes.margins(x=0.1)
    axes.set_xlim(left=0.0)
    return figure
