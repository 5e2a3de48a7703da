"""`trainer bench`: cost of the parts of the trainer on this machine."""

import json
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numba
import numpy as np
from pydantic import TypeAdapter, ValidationError
from rich import box as borders
from rich.console import Console
from rich.table import Table

from bench.common.clock import Figure, by_turns, figure, keep, stream
from bench.speed.cut import cut
from bench.speed.flow import codec, session
from bench.speed.frame import frame
from bench.speed.parts import Part
from bench.speed.proxy import proxy
from bench.speed.start import start
from bench.speed.tissue import force, step
from cutting_trainer.session.errors import SessionError

_BANDWIDTHS = (1, 10, 40, 100)
"""Sizes within the caches and beyond [MB]."""

BENCHES: dict[Part, tuple[Callable[..., list[Figure]], list[int]]] = {
    Part.FORCE: (force, [1_000, 10_000, 50_000, 200_000]),
    Part.STEP: (step, [10_000, 50_000]),
    Part.FRAME: (frame, [10_000, 50_000, 200_000]),
    Part.CUT: (cut, [2_000, 20_000, 200_000]),
    Part.PROXY: (proxy, []),
    Part.CODEC: (codec, [10_000, 200_000]),
    Part.SESSION: (session, [10_000]),
    Part.START: (start, []),
}
"""Each part with its default sizes; parts without any have one."""


@dataclass(frozen=True)
class Report:
    """Result of a run of `bench`.

    Attributes:
        when: its end (ISO 8601).
        machine: processor and versions, by name.
        figures: by benchmark, that of the memory first.
    """

    when: str
    machine: dict[str, str]
    figures: dict[str, list[Figure]]


def run_bench(
    names: list[Part], sizes: list[int], *, as_json: bool, save: bool, against: Path | None = None
) -> None:
    """Measure, print, and optionally save the figures.

    Args:
        names: of benchmarks; none: all.
        sizes: in tetrahedra; none: each benchmark's own.
        as_json: print JSON.
        save: write the same JSON to bench/results.
        against: the file of an earlier run, whose figures are printed beside.

    Raises:
        SessionError: sizes were given to a benchmark that has none, or the file is not of a run.
    """
    wanted = list(dict.fromkeys(names)) or list(Part)
    if sizes and names and all(not BENCHES[name][1] for name in wanted):
        raise SessionError(
            f'bench speed {" ".join(wanted)} has no size: leave --size out, or name one of '
            + ', '.join(name for name, (_, own) in BENCHES.items() if own)
        )
    before = read_report(against) if against is not None else None
    found: dict[str, list[Figure]] = {'memory': bandwidth()}
    for wish in wanted:
        run, own = BENCHES[wish]
        found[wish.value] = run(sizes or own) if own else run()
    report = Report(time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime()), _machine(), found)
    console = Console(width=None if sys.stdout.isatty() else 160)
    if as_json:
        told = asdict(report) | ({'against': asdict(before)} if before else {})
        console.out(json.dumps(told, indent=2), highlight=False)
    else:
        for name in found:
            console.print(_table(name, report, before))
        if before is not None:
            console.print(_machines(report, before), highlight=False, soft_wrap=True)
    if save:
        target = keep(asdict(report), '-'.join(wanted) if len(wanted) < len(Part) else 'all')
        Console(stderr=True).print(f'saved to {target}', highlight=False)


def read_report(path: Path) -> Report:
    """Read the file of `--save`, or the output of `--json`.

    Raises:
        SessionError: there is no such file, or it is another.
    """
    try:
        return TypeAdapter(Report).validate_json(path.read_bytes())
    except OSError as error:
        raise SessionError(f'{path}: {error.strerror}; bench speed --save keeps one') from None
    except ValidationError as error:
        wrong = error.errors()[0]
        place = '.'.join(str(part) for part in wrong['loc'])
        raise SessionError(
            f'{path} is not of a run of bench speed: {f"{place}: " if place else ""}'
            f'{wrong["msg"]}; bench speed --save keeps one'
        ) from None


def bandwidth() -> list[Figure]:
    """Return the figures of the memory bandwidth of one thread."""
    return [
        figure(f'reading {size} MB', 'GB/s', 1e-3 * size / by_turns(stream(size * 1e6))[:, 0])
        for size in _BANDWIDTHS
    ]


def _machine() -> dict[str, str]:
    words = Path('/proc/cpuinfo').read_text().splitlines()
    model = next((line.split(':')[1].strip() for line in words if 'model name' in line), '')
    versions = {'python': platform.python_version(), 'numba': numba.__version__}
    return {'processor': model, 'numpy': np.__version__, **versions}


def _table(name: str, report: Report, before: Report | None) -> Table:
    table = Table(title=name, box=borders.SIMPLE_HEAD, title_justify='left')
    then = {row.name: row for row in before.figures.get(name, [])} if before else {}
    columns = ['', 'median', 'tenth to ninetieth percentile', '', 'ratio', 'to']
    for column in columns + (['median then', 'ratio then'] if before else []):
        table.add_column(column, justify='left' if column in ('', 'to') else 'right')
    for row in report.figures[name]:
        spread = f'{row.low:.4g} to {row.high:.4g}'
        cells = [row.name, f'{row.median:.4g}', spread, row.unit, _ratio(row), row.against]
        if (old := then.get(row.name)) is not None:
            cells += [f'{old.median:.4g}', _ratio(old)]
        table.add_row(*cells)
    return table


def _ratio(row: Figure) -> str:
    return '' if row.ratio is None else f'{row.ratio:.2f}'


def _machines(report: Report, before: Report) -> str:
    """Return the figures that are comparable with an earlier run."""
    changed = [
        f'{name} {before.machine.get(name, "unknown")}, now {value}'
        for name, value in report.machine.items()
        if before.machine.get(name) != value
    ]
    start = f'Then: {before.when}'
    if not changed:
        return f'{start}, on a machine of the same name; its load may have been another.'
    return f'{start}, {"; ".join(changed)}. Compare ratios rather than medians.'
