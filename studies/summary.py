"""Summary of a study, as text and as a page with plots."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.console import Group
from rich.markup import escape as escape_markup
from rich.table import Table

from cutting_trainer.recordings.html_page import image, page, table
from cutting_trainer.recordings.picture import STYLE
from cutting_trainer.studies.accuracy_and_cost import (
    HEAD,
    MEANING,
    NARROW,
    Tradeoff,
    tradeoff_figure,
    tradeoffs,
)
from cutting_trainer.studies.description import Study
from cutting_trainer.studies.effects import (
    MIN_BAGS,
    Effect,
    effects_of_keys,
    effects_of_settings,
)
from cutting_trainer.studies.outputs import COMPARED, OUTPUTS
from cutting_trainer.studies.table import Row

PAGE_FILE = 'summary.html'
MAX_LINES = 40
"""Effects in the terminal; the page has all."""
_MAX_PANELS = 6
_MAX_CAUSES = 16
"""Settings of the plot; with more of them it shows the keys."""
_MAX_REASONS = 10
_ROUNDING = 1e-9
"""Share of an effect below which the end of its interval is shown as 0."""


@dataclass(frozen=True)
class StudySummary:
    """Effects of a study, and the sentences beside them.

    Attributes:
        settings, keys: effects on the outputs that a setting changes in some bag.
        tradeoffs: error and cost of each setting, where the study has a reference.
        unchanged: outputs that no setting changes in any bag.
        failures: number of rows by reason.
        notes: sentences.
    """

    settings: list[Effect]
    keys: list[Effect]
    tradeoffs: list[Tradeoff]
    unchanged: list[str]
    failures: dict[str, int]
    notes: list[str] = field(default_factory=list)


def summarise(rows: Sequence[Row], study: Study, planned: int) -> StudySummary:
    """Compute the effects of the settings of a study.

    Args:
        rows: that are done.
        study: its outputs and level of confidence.
        planned: number of rows of the whole study.
    """
    outputs = study.outputs
    if study.reference is not None:  # an error, whose effect would be the difference of two
        outputs = [name for name in outputs if name not in COMPARED]
    every = effects_of_settings(rows, outputs, study.confidence)
    keys, why_not = effects_of_keys(_designed(rows), outputs, study.confidence)
    known = {effect.output for effect in every}
    changed = {effect.output for effect in every if not effect.is_zero}
    settings = [effect for effect in every if effect.output in changed]
    failures = Counter(row.result.failure for row in rows if row.result.failure)
    notes = [
        f'{len(rows)} of {planned} rows are done; each bag has one of its session as recorded',
        f'intervals: {study.confidence:.1%} by bootstrap over bags; effects are differences to the '
        'sessions as recorded',
    ]
    if every and (missing := [name for name in outputs if name not in known]):
        notes.append(f'without a value as recorded, and so without an effect: {", ".join(missing)}')
    counts = {effect.bags for effect in every}
    if counts and min(counts) < MIN_BAGS:
        notes.append(
            f'some effects are of fewer than {MIN_BAGS} bags ({min(counts)}): their intervals are '
            'too narrow'
        )
    if why_not:
        notes.append(why_not)
    kinds = {row.result.identity.processor for row in rows if not row.result.lost}
    if len(kinds) > 1:
        notes.append(f'{len(kinds)} kinds of processors have computed it: they round differently')
    differing = [row.bag.name for row in rows if row.result.differs_from_frame]
    if differing:
        notes.append(
            'computed again, these bags are not quite the recorded ones (`./trainer resimulate` '
            f'says where): {", ".join(differing)}'
        )
    return StudySummary(
        settings=_by_output(settings, outputs),
        keys=_by_output([effect for effect in keys if effect.output in changed], outputs),
        tradeoffs=tradeoffs(rows, study.confidence),
        unchanged=[name for name in outputs if name in known - changed],
        failures=dict(failures.most_common()),
        notes=notes,
    )


def _designed(rows: Sequence[Row]) -> list[Row]:
    """Return the rows without a reference that changes other keys than the designs do."""
    keys = {key for row in rows if not row.is_reference for key in row.setting.changes}
    return [row for row in rows if not row.is_reference or row.setting.changes.keys() == keys]


def _by_output(effects: Iterable[Effect], outputs: list[str]) -> list[Effect]:
    return sorted(effects, key=lambda effect: outputs.index(effect.output))


def as_text(summary: StudySummary) -> Group:
    """Return a summary for the terminal: effects of keys, or of settings where keys have none."""
    parts: list[Any] = []
    if summary.tradeoffs:
        beside = _empty_table(HEAD[:NARROW])
        for one in summary.tradeoffs[:MAX_LINES]:
            beside.add_row(*map(escape_markup, one.cells[:NARROW]))
        parts += [beside, MEANING]
        if len(summary.tradeoffs) > MAX_LINES:
            parts.append('the page has all settings')
    effects = summary.keys or summary.settings
    shown = _empty_table(_HEAD[1:])
    output = ''
    for effect in effects[:MAX_LINES]:
        name, *cells = map(escape_markup, _cells(effect))
        if name != output:
            shown.add_row(f'[bold]{name}[/]')
            output = name
        shown.add_row(f'  {cells[0]}', *cells[1:])
    if effects:
        parts.append(shown)
    if len(effects) > MAX_LINES or effects is not summary.settings:
        parts.append('the page has all effects')
    parts += [escape_markup(sentence) for sentence in _sentences(summary)]
    return Group(*parts)


def _empty_table(head: Sequence[str]) -> Table:
    empty = Table(box=box.SIMPLE_HEAD)
    for number, name in enumerate(head):
        justify: Any = 'right' if number else 'left'
        empty.add_column(escape_markup(name), justify=justify, overflow='fold')
    return empty


def write_page(file: Path, title: str, summary: StudySummary) -> None:
    """Write a summary as a page.

    Args:
        file: to write; it is replaced in one step.
        title: name of the study.
        summary: its content.
    """
    parts = [f'<h1>Study {escape(title)}</h1>']
    with mpl.rc_context(STYLE):
        figure = effects_figure(summary)
        if figure is not None:
            caption = 'Change of each output, and its confidence interval over bags.'
            parts.append(image(figure, caption))
        if summary.tradeoffs:
            parts.append('<h2>Accuracy and cost</h2>')
            if (figure := tradeoff_figure(summary.tradeoffs)) is not None:
                parts.append(image(figure, MEANING))
            numbered = enumerate(summary.tradeoffs, start=1)
            parts.append(table([(str(n), *one.cells) for n, one in numbered], ('', *HEAD)))
    for heading, effects in _sections(summary):
        parts += [f'<h2>{escape(heading)}</h2>', table([_cells(e) for e in effects], _HEAD)]
    parts += [f'<p class="note">{escape(text)}</p>' for text in _sentences(summary)]
    new = file.with_suffix('.new')
    new.write_text(page(f'Study {title}', '\n'.join(parts)), encoding='utf-8')
    new.replace(file)


def effects_figure(summary: StudySummary) -> Figure | None:
    """Return a plot of the effects with their intervals; None: there are none."""
    causes = {effect.cause for effect in summary.settings}
    effects = summary.settings if len(causes) <= _MAX_CAUSES or not summary.keys else summary.keys
    names = list(dict.fromkeys(effect.cause for effect in effects))[:_MAX_CAUSES]
    outputs = list(dict.fromkeys(effect.output for effect in effects))[:_MAX_PANELS]
    if not names:
        return None
    columns = min(len(outputs), 2)
    lines = -(-len(outputs) // columns)
    size = (10.0, lines * (1.1 + 0.24 * len(names)))
    figure = Figure(figsize=size, layout='constrained')
    panels: Any = figure.subplots(lines, columns, squeeze=False, sharey=True)
    for axes in panels.flat[len(outputs) :]:
        axes.set_visible(False)
    for axes, output in zip(panels.flat, outputs, strict=False):
        shown = [e for e in effects if e.output == output and e.cause in names]
        at = [names.index(effect.cause) for effect in shown]
        means = np.array([effect.mean for effect in shown])
        ends = np.array([[e.mean - e.low, e.high - e.mean] for e in shown]).T
        axes.axvline(0.0, color='#aaaaaa', lw=0.8)
        axes.errorbar(
            means, at, xerr=np.nan_to_num(ends), fmt='o', ms=4, capsize=3, color='#1f4e8c'
        )
        unit = f' [{OUTPUTS[output].unit}]' if OUTPUTS[output].unit else ''
        axes.set(xlabel=f'{output}{unit}', ylim=(len(names) - 0.5, -0.5))
        axes.locator_params(axis='x', nbins=5)
        axes.set_yticks(range(len(names)), names)
    return figure


_HEAD = ('output', 'change', 'as recorded', 'effect', 'interval', 'bags')


def _sections(summary: StudySummary) -> list[tuple[str, list[Effect]]]:
    found = [('Effect of each setting', summary.settings), ('Effect of each key', summary.keys)]
    return [(title, effects) for title, effects in found if effects]


def _cells(effect: Effect) -> tuple[str, ...]:
    unit = OUTPUTS[effect.output].unit
    name = f'{effect.output} [{unit}]' if unit else effect.output
    reference = '' if np.isnan(effect.reference) else f'{effect.reference:.4g}'
    low, high = (
        0.0 if abs(e) < _ROUNDING * abs(effect.mean) else e for e in (effect.low, effect.high)
    )
    ends = 'one bag' if np.isnan(effect.low) else f'{low:+.3g} to {high:+.3g}'
    return name, effect.cause, reference, f'{effect.mean:+.3g}', ends, str(effect.bags)


def _sentences(summary: StudySummary) -> list[str]:
    """Return the notes, and the failures with their reasons."""
    lines = list(summary.notes)
    if summary.unchanged:
        lines.append(f'no setting changes {", ".join(summary.unchanged)} in any bag')
    for number, (reason, count) in enumerate(summary.failures.items()):
        if number == _MAX_REASONS:
            lines.append(f'and {len(summary.failures) - number} more reasons; the table has all')
            break
        lines.append(f'failed, {count} rows: {reason}')
    return lines
