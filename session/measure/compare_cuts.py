"""The command `trainer compare-cuts`: methods of cutting side by side, in docs/cut-methods.md."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from session.errors import SessionError
from session.measure.cut_comparison import compare, rk4_milliseconds, spread
from session.measure.cut_picture import write_all
from session.measure.cut_strokes import random_planes, strokes


def run_comparison(folder: Path, *, as_json: bool = False) -> None:
    """Compares, and writes the page, the table and the picture to a folder.

    Args:
        folder: that exists.
        as_json: print the table as JSON.

    Raises:
        SessionError: it does not.
    """
    if not folder.is_dir():
        raise SessionError(f'{folder} is no folder: make it first, the comparison goes into it')
    console = Console(stderr=True, highlight=False)
    with console.status('') as line:
        rows, shown = compare(line.update)
        line.update('random planes')
        planes = random_planes()
        spreads = {
            name: spread(tuple(stroke for stroke in planes if stroke.name == name))
            for name in ('block', 'liver')
        }
        write_all(folder, rows, shown, strokes()[0], rk4_milliseconds(), spreads)
    console.print(f'{folder / "cut-methods.md"} has {len(rows)} rows')
    if as_json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
