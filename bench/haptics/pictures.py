"""Pictures of the haptics: the stability map, and the energy of the forces."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.haptics.energy import Energy
from bench.haptics.stability_map import (
    DELAYS,
    HAND_STIFFNESSES,
    LOSSES,
    TISSUE_STIFFNESSES,
    Cell,
    Outcome,
)
from cutting_trainer.session.in_process import TICK_S

_STYLE: Any = {'font.size': 8, 'svg.hashsalt': 'equal runs, equal files'}
_COLOURS = ('#3b8a5a', '#e8c468', '#c8553d')
_NAMES = ('stable and passive', 'stable, makes energy', 'not stable')


def draw_stability(file: Path, results: dict[Cell, Outcome]) -> None:
    """Draw a panel by law, without and with the controller: hand and tissue in blocks of delay and
    loss.

    Args:
        file: to write.
        results: of whole maps.
    """
    laws = list(dict.fromkeys(cell.law for cell in results))
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(10, 2.9 * len(laws)), layout='constrained')
        axes = figure.subplots(len(laws), 2, squeeze=False)
        for row, law in zip(axes, laws, strict=True):
            for ax, controlled in zip(row, (False, True), strict=True):
                _panel(ax, law, controlled, results)
        figure.legend(
            handles=[Patch(color=c, label=n) for c, n in zip(_COLOURS, _NAMES, strict=True)],
            loc='outside lower center',
            ncols=3,
        )
        figure.savefig(file, dpi=110)


def _panel(ax: Any, law: str, controlled: bool, results: dict[Cell, Outcome]) -> None:
    codes = np.array(
        [
            [
                _code(results[Cell(law, hand, tissue, delay, loss, controlled)])
                for delay in DELAYS
                for loss in LOSSES
            ]
            for tissue in TISSUE_STIFFNESSES
            for hand in HAND_STIFFNESSES
        ]
    )
    ax.imshow(codes, cmap=ListedColormap(_COLOURS), vmin=0, vmax=2, aspect='auto')
    ax.set_xticks(
        range(codes.shape[1]), [f'{100 * loss:g}' for _ in DELAYS for loss in LOSSES], fontsize=6
    )
    ax.set_yticks(
        range(codes.shape[0]),
        [f'{t:g} / {h:g}' for t in TISSUE_STIFFNESSES for h in HAND_STIFFNESSES],
        fontsize=6,
    )
    for i in range(1, len(DELAYS)):
        ax.axvline(i * len(LOSSES) - 0.5, color='white', lw=1.5)
    for i in range(1, len(TISSUE_STIFFNESSES)):
        ax.axhline(i * len(HAND_STIFFNESSES) - 0.5, color='white', lw=1.5)
    delays = ', '.join(f'{1e3 * delay:g}' for delay in DELAYS)
    ax.set_xlabel(f'loss [%], in blocks of delay each way [ms]: {delays}')
    ax.set_ylabel('tissue / hand [N/m]')
    ax.set_title(f'{law}, {"with" if controlled else "without"} passivity controller', fontsize=9)


def _code(outcome: Outcome) -> int:
    return 2 if not outcome.stable else 0 if outcome.passive else 1


def draw_energies(file: Path, budget: list[Energy]) -> None:
    """Draw the energy from the hand over time.

    Args:
        file: to write.
        budget: by force.
    """
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(8, 3.4), layout='constrained')
        ax = figure.subplots()
        for energy in budget:
            ax.plot(
                np.arange(len(energy.trace)) * TICK_S, 1e3 * energy.trace, lw=1, label=energy.name
            )
        ax.set_xlabel('time [s]')
        ax.set_ylabel('put in by the hand [mJ]')
        ax.grid(color='#e4e4e4', lw=0.5)
        ax.legend(fontsize=7, loc='upper left', bbox_to_anchor=(1, 1))
        figure.savefig(file, dpi=120)
