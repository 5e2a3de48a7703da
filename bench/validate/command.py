"""`trainer validate`: published experiments beside what the trainer gives."""

import json
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.accuracy.chart import machine
from bench.validate.case import Case, Result
from bench.validate.cases import CASES, NOT_REPRODUCED
from bench.validate.picture import draw
from cutting_trainer.cutting.scene_schema import CuttingSettings
from cutting_trainer.cutting.warm_up import warm_up as warm_up_cutting
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.elasticity.models import MODELS
from cutting_trainer.tissue_sim.warm_up import warm_up

Results = dict[str, list[Result]]
MARK = '<!-- Below: written by `./trainer validate -o docs`. -->\n'


def run_validate(
    names: list[str], *, quick: bool, folder: Path | None = None, as_json: bool = False
) -> None:
    """Run cases, and print their table.

    Args:
        names: of the cases; none: all.
        quick: only the coarsest mesh of each.
        folder: for page and picture; None: neither is written.
        as_json: print JSON instead of the table.

    Raises:
        SessionError: there is no such case or folder.
    """
    for name in names:
        if name not in CASES:
            raise SessionError(f'there is no case {name!r}: there are {", ".join(CASES)}')
    if folder is not None and not folder.is_dir():
        raise SessionError(f'{folder} is no folder: make it first, the page goes into it')
    console = Console(highlight=False, stderr=as_json)
    warm_up()
    warm_up_cutting(CuttingSettings())
    results: Results = {}
    with console.status('') as line:
        for name in dict.fromkeys(names) or CASES:
            (line.update if console.is_terminal else console.print)(CASES[name].title)
            results[name] = CASES[name].run(quick)
    if folder is not None:
        write(folder, results)
    if as_json:
        print(json.dumps(content(results), indent=2, allow_nan=False))
    else:
        print_table(console, results)


def content(results: Results) -> dict[str, object]:
    """Return the content of the JSON output."""
    cases = []
    for name, rows in results.items():
        case = CASES[name]
        figures = [asdict(row) | {'inside': row.inside(case.tolerance)} for row in rows]
        head = {key: getattr(case, key) for key in ('name', 'title', 'tolerance')}
        head |= {'tolerance_reason': case.tolerance_reason}
        head |= {'sources': [asdict(source) for source in case.sources]}
        cases.append(head | {'results': figures})
    missing = [asdict(one) for one in NOT_REPRODUCED]
    return {'machine': machine(), 'cases': cases, 'not_reproduced': missing}


def print_table(console: Console, results: Results) -> None:
    """Print the results for people."""
    for name, rows in results.items():
        case = CASES[name]
        places = '; '.join(f'{s.name}, {s.place} ({s.how})' for s in case.sources)
        table = Table(title=f'{name}: {case.title}', caption=places, box=None)
        heads = ('quantity', 'model', 'tetrahedra', 'published', 'trainer', 'error', 'CPU s', '')
        for head in heads:
            table.add_column(head)
        for row in rows:
            table.add_row(*_cells(row, case))
        console.print(table)
    if len(results) == len(CASES):
        for one in NOT_REPRODUCED:
            console.print(f'not reproduced: {one.title} ({one.source.name}): {one.reason}')


def _cells(row: Result, case: Case) -> tuple[str, ...]:
    value = '-' if row.value is None else f'{row.value:.4g} {row.unit}'.strip()
    error = '-' if row.error is None else f'{100 * row.error:+.1f} %'
    verdict = row.note or ('inside' if row.inside(case.tolerance) else 'outside')
    exact = f'{row.published:.4g} {row.unit}'.strip()
    count = str(row.tetrahedra)
    return row.quantity, row.model, count, exact, value, error, f'{row.cpu:.2g}', verdict


def write(folder: Path, results: Results) -> None:
    """Write the tables of the page below its mark, and the picture.

    Args:
        folder: with validate.md.
        results: of the cases that ran.
    """
    charts = folder / 'charts'
    charts.mkdir(exist_ok=True)
    draw(results).savefig(charts / 'validate.png', dpi=110)
    page = folder / 'validate.md'
    head = page.read_text(encoding='utf-8').partition(MARK)[0] if page.exists() else ''
    page.write_text(head + MARK + '\n' + tables(results), encoding='utf-8')


def _summary(rows: list[Result], model: str, tolerance: float) -> str:
    """Return how many results of a model keep the tolerance, and the span of their errors."""
    own = [row for row in rows if row.model == model]
    if not own:
        return ''
    said = [f'{sum(row.inside(tolerance) for row in own)} of {len(own)}']
    errors = [100 * row.error for row in own if row.error is not None]
    if errors:
        said.append(' to '.join(f'{e:+.1f}' for e in dict.fromkeys((min(errors), max(errors)))))
    notes = [row.note for row in own if row.error is None and row.note]
    return '; '.join(said + notes[-1:])


def tables(results: Results) -> str:
    """Return the tables of the page: each case by model on its finest mesh."""
    lines = [f'Machine: {machine()}.\n', f'| case, tetrahedra | {" | ".join(MODELS)} |']
    lines.append('|---' * (1 + len(MODELS)) + '|')
    for name, rows in results.items():
        finest = max(row.tetrahedra for row in rows)
        own = [row for row in rows if row.tetrahedra == finest]
        for variant in dict.fromkeys(row.model.partition(', ')[2] for row in own):
            suffix = f', {variant}' if variant else ''
            cells = [_summary(own, model + suffix, CASES[name].tolerance) for model in MODELS]
            lines.append(f'| `{name}`{suffix}, {finest} | {" | ".join(cells)} |')
    lines += ['\n| case | published | tolerance |', '|---|---|---|']
    for name in results:
        case = CASES[name]
        places = '; '.join(f'{s.name}, {s.place} ({s.how})' for s in case.sources)
        tolerance = f'{100 * case.tolerance:g} %: {case.tolerance_reason}'
        lines.append(f'| `{name}`: {case.title} | {places} | {tolerance} |')
    lines += ['\n| not reproduced | source | reason |', '|---|---|---|']
    lines += [
        f'| {one.title} | {one.source.name}, {one.source.place} | {one.reason} |'
        for one in NOT_REPRODUCED
    ]
    return '\n'.join(lines) + '\n'
