"""`trainer compare-cuts`: methods of cutting side by side, in docs/cut-methods.md."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from bench.common.marked_page import page_in
from bench.cuts.comparison import compare, rk4_milliseconds, spread
from bench.cuts.picture import write_all
from bench.cuts.strokes import random_planes, strokes


def run_comparison(folder: Path, *, as_json: bool = False) -> None:
    """Compare, and write tables, CSV file and picture to a folder.

    Args:
        folder: existing folder with cut-methods.md.
        as_json: print the table as JSON.

    Raises:
        SessionError: there is no such page.
    """
    page = page_in(folder, 'cut-methods.md')
    console = Console(stderr=True, highlight=False)
    with console.status('') as line:
        rows, shown = compare(line.update)
        line.update('random planes')
        planes = random_planes()
        spreads = {
            name: spread(tuple(stroke for stroke in planes if stroke.name == name))
            for name in ('block', 'liver')
        }
        write_all(folder, rows, shown, strokes()[0], spreads)
        rk4 = rk4_milliseconds()
    console.print(
        f'{page} has {len(rows)} rows; an RK4 step of 10,000 tetrahedra took {rk4:.2f} ms'
    )
    if as_json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
