"""Page of an identified material: constants with intervals, recorded and computed force."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from cutting_trainer.recordings.html_page import image, page, table
from cutting_trainer.recordings.picture import STYLE
from cutting_trainer.studies.fit import Floats, Observation
from cutting_trainer.studies.identification import PARAMETERS, Estimate

_MAX_PANELS = 12
_HEAD = ('constant', 'value', 'interval of 95 %', 'prior', 'source of the prior')


def write_identification_page(
    file: Path,
    names: Sequence[str],
    estimates: Mapping[str, Estimate],
    sentences: Sequence[str],
    observations: Sequence[Observation],
    forces: Sequence[Floats],
) -> None:
    """Write the page.

    Args:
        file: to write.
        names: of the bags.
        estimates: by constant.
        sentences: notes.
        observations: recorded forces.
        forces: computed at the solution [N], each shape (n, 3).
    """
    rows = [
        (
            f'{name} [{PARAMETERS[name]}]',
            f'{e.value:.4g}',
            f'{e.low:.4g} to {e.high:.4g}',
            e.prior.text,
            e.prior.source,
        )
        for name, e in estimates.items()
    ]
    parts = ['<h1>Identified material</h1>', table(rows, _HEAD)]
    parts += [f'<p class="note">{escape(sentence)}</p>' for sentence in sentences]
    with mpl.rc_context(STYLE):
        figure = _figure(names, observations, forces)
        parts.append(image(figure, 'Force on the hand as recorded and as computed.'))
    file.write_text(page('Identified material', '\n'.join(parts)), encoding='utf-8')


def _figure(
    names: Sequence[str], observations: Sequence[Observation], forces: Sequence[Floats]
) -> Figure:
    shown = min(len(names), _MAX_PANELS)
    lines = -(-shown // 2)
    figure = Figure(figsize=(10.0, 2.2 * lines), layout='constrained')
    panels: Any = figure.subplots(lines, 2, squeeze=False)
    for axes in panels.flat[shown:]:
        axes.set_visible(False)
    for axes, name, observed, computed in zip(
        panels.flat, names, observations, forces, strict=False
    ):
        axes.plot(observed.times, np.linalg.norm(observed.felt, axis=1), lw=0.7, label='recorded')
        axes.plot(observed.times, np.linalg.norm(computed, axis=1), lw=1.0, label='computed')
        axes.set(title=name, xlabel='time [s]', ylabel='force [N]')
    panels[0][0].legend()
    return figure
