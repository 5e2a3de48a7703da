"""The commands `bench haptics-accuracy` and `bench haptics-stability`: docs/haptics.md."""

import csv
import json
import os
from dataclasses import asdict, astuple, fields
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console

from bench.common.marked_page import page_in, put_table
from bench.haptics.accuracy import MOTIONS, Row, compare, missed_bounds
from bench.haptics.energy import energies, energies_table
from bench.haptics.pictures import draw_energies, draw_stability
from bench.haptics.stability_map import (
    LAWS,
    Cell,
    Outcome,
    counts,
    default_failures,
    places,
    run_place,
)


def run_accuracy(folder: Path, *, as_json: bool = False) -> list[str]:
    """Run all; write the table, the picture of the energies, and the table in haptics.md.

    Args:
        folder: that exists and has haptics.md.
        as_json: print the figures as JSON.

    Returns:
        Where the default misses its bar, in sentences.

    Raises:
        SessionError: there is no such page.
    """
    page = page_in(folder, 'haptics.md')
    console = Console(stderr=True, highlight=False)
    rows: list[Row] = []
    with console.status('') as line, get_context('spawn').Pool(os.cpu_count() or 1) as pool:
        tapped = pool.apply_async(energies)
        for motion in pool.imap(compare, [motion.name for motion in MOTIONS], chunksize=1):
            rows += motion
            line.update(f'{rows[-1].motion} is done')
        budget = tapped.get()
    with (folder / 'haptics-accuracy.csv').open('w', newline='', encoding='utf-8') as out:
        table = csv.writer(out, lineterminator='\n')
        table.writerow([field.name for field in fields(Row)])
        for row in rows:
            table.writerow([x if isinstance(x, str) else f'{x:.4g}' for x in astuple(row)])
    draw_energies(folder / 'images' / 'haptics-energy.png', budget)
    put_table(page, 'errors', _errors_table(rows))
    put_table(page, 'energies', energies_table(budget))
    console.print(f'{page} has {len(rows)} rows of errors')
    if as_json:
        figures = {'errors': [asdict(row) for row in rows], 'energies': [e.figures for e in budget]}
        print(json.dumps(figures | {'missed': missed_bounds(rows)}, indent=2))
    return missed_bounds(rows)


def _errors_table(rows: list[Row]) -> list[str]:
    """Return a row for each motion; in each cell median and worst."""
    laws = list(dict.fromkeys(row.law for row in rows))
    head = ' | '.join(f'`{law}`' for law in laws)
    lines = [f'| motion | {head} |', '|---' * (1 + len(laws)) + '|']
    for motion in dict.fromkeys(row.motion for row in rows):
        cells = {row.law: (row.median, row.worst) for row in rows if row.motion == motion}
        numbers = (', '.join(f'{number:.1f}' for number in cells[law]) for law in laws)
        lines.append(f'| {motion} | {" | ".join(numbers)} |')
    return lines


def run_stability(
    folder: Path, laws: tuple[str, ...] = LAWS, *, as_json: bool = False
) -> list[str]:
    """Run the map; write all cells, the picture, and the table in haptics.md.

    Args:
        folder: that exists and has haptics.md.
        laws: of extrapolation.
        as_json: print the counts as JSON.

    Returns:
        Failures of the default, in sentences.

    Raises:
        SessionError: there is no such page.
    """
    page = page_in(folder, 'haptics.md')
    console, todo = Console(stderr=True, highlight=False), places(laws)
    results: dict[Cell, Outcome] = {}
    with console.status('') as line, get_context('spawn').Pool(os.cpu_count() or 1) as pool:
        for done in pool.imap(run_place, todo, chunksize=4):
            results.update(done)
            line.update(f'{len(results)} of {2 * len(todo)} cells')
    _write_map(folder / 'haptics-stability.csv', results)
    draw_stability(folder / 'images' / 'haptics-stability.png', results)
    put_table(page, 'stability', _table(results))
    console.print(f'{folder / "haptics-stability.csv"} has {len(results)} rows')
    if as_json:
        figures = [asdict(count) for count in counts(results)]
        print(json.dumps({'laws': figures, 'broken': default_failures(results)}, indent=2))
    return default_failures(results)


def _table(results: dict[Cell, Outcome]) -> list[str]:
    found = counts(results)
    cells, bound = found[0].cells, found[0].bound
    lines = [
        f'| law, controller | stable, of {cells} | passive too | up to 50 ms and 5 %, of {bound} |',
        '|---|---:|---:|---:|',
    ]
    for count in found:
        with_ = 'with' if count.controlled else 'without'
        numbers = f'{count.stable} | {count.both} | {count.both_bound}'
        lines.append(f'| `{count.law}`, {with_} | {numbers} |')
    return lines


def _write_map(file: Path, results: dict[Cell, Outcome]) -> None:
    """Write every cell as a row."""
    with file.open('w', newline='', encoding='utf-8') as out:
        rows = csv.writer(out, lineterminator='\n')
        names = [field.name for field in fields(Cell)]
        rows.writerow([*names, 'swing_m', 'made_joule', 'stable', 'passive'])
        for cell, o in results.items():
            numbers = (f'{o.swing:.6g}', f'{o.made:.6g}', int(o.stable), int(o.passive))
            rows.writerow([*astuple(cell), *numbers])
