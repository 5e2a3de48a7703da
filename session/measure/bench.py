"""The command `bench`: what the parts of the trainer cost on this machine."""

import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numba
import numpy as np
from rich import box as borders
from rich.console import Console
from rich.table import Table

from session.errors import SessionError
from session.measure.bench_clock import Figure, by_turns, figure, keep, stream
from session.measure.bench_cut import cut
from session.measure.bench_flow import codec, session
from session.measure.bench_frame import frame
from session.measure.bench_proxy import proxy
from session.measure.bench_start import start
from session.measure.bench_tissue import force, step
from session.options import Bench

_BANDWIDTHS = (1, 10, 40, 100)
"""[MB]: of the caches, and of memory."""

BENCHES: dict[Bench, tuple[Callable[..., list[Figure]], list[int]]] = {
    Bench.FORCE: (force, [1_000, 10_000, 50_000, 200_000]),
    Bench.STEP: (step, [10_000, 50_000]),
    Bench.FRAME: (frame, [10_000, 50_000, 200_000]),
    Bench.CUT: (cut, [2_000, 20_000, 200_000]),
    Bench.PROXY: (proxy, []),
    Bench.CODEC: (codec, [10_000, 200_000]),
    Bench.SESSION: (session, [10_000]),
    Bench.START: (start, []),
}
"""Each with the sizes that it runs at unless it is told; those without any have one."""


def run_bench(names: list[Bench], sizes: list[int], *, as_json: bool, save: bool) -> None:
    """Measures, prints, and keeps the figures if it is told to.

    Args:
        names: of benchmarks; none: all.
        sizes: in tetrahedra; none: each benchmark's own.
        as_json: print JSON.
        save: write the same JSON to bench/results.

    Raises:
        SessionError: sizes were given to a benchmark that has none.
    """
    wanted = list(dict.fromkeys(names)) or list(Bench)
    if sizes and names and all(not BENCHES[name][1] for name in wanted):
        raise SessionError(
            f'bench {" ".join(wanted)} has no size: leave --size out, or name one of '
            + ', '.join(name for name, (_, own) in BENCHES.items() if own)
        )
    found: dict[str, list[Figure]] = {'memory': bandwidth()}
    for wish in wanted:
        run, own = BENCHES[wish]
        found[wish.value] = run(sizes or own) if own else run()
    report = {
        'when': time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime()),
        'machine': _machine(),
        'figures': {name: [asdict(row) for row in rows] for name, rows in found.items()},
    }
    console = Console()
    if as_json:
        console.out(json.dumps(report, indent=2), highlight=False)
    else:
        for name, rows in found.items():
            console.print(_table(name, rows))
    if save:
        target = keep(report, '-'.join(wanted))
        Console(stderr=True).print(f'saved to {target}', highlight=False)


def bandwidth() -> list[Figure]:
    """What one thread reads of memory."""
    return [
        figure(f'reading {size} MB', 'GB/s', 1e-3 * size / by_turns(stream(size * 1e6))[:, 0])
        for size in _BANDWIDTHS
    ]


def _machine() -> dict[str, str]:
    words = Path('/proc/cpuinfo').read_text().splitlines()
    model = next((line.split(':')[1].strip() for line in words if 'model name' in line), '')
    versions = {'python': platform.python_version(), 'numba': numba.__version__}
    return {'processor': model, 'numpy': np.__version__, **versions}


def _table(title: str, rows: list[Figure]) -> Table:
    table = Table(title=title, box=borders.SIMPLE_HEAD, title_justify='left')
    for column in ('', 'median', 'tenth to ninetieth percentile', '', 'ratio', 'to'):
        table.add_column(column, justify='left' if column in ('', 'to') else 'right')
    for row in rows:
        spread = f'{row.low:.4g} to {row.high:.4g}'
        ratio = '' if row.ratio is None else f'{row.ratio:.2f}'
        table.add_row(row.name, f'{row.median:.4g}', spread, row.unit, ratio, row.against)
    return table
