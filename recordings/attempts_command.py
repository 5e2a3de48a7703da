"""`trainer attempts`: index bags, list, compare, draw curves, export, delete by subject."""

import csv
import math
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet as pq
from rich.markup import escape
from rich.table import Table

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.bags.playback_messages import first_time
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.exercises.attempt_store import (
    AttemptRow,
    AttemptStore,
    LearningCurve,
    attempt_number,
    learning_curves,
)
from cutting_trainer.exercises.bag_feed import read_attempt
from cutting_trainer.exercises.scene_schema import MEASURES
from cutting_trainer.exercises.score import UNITS, in_words, score
from cutting_trainer.recordings.html_report import recorded
from cutting_trainer.session.errors import SessionError

_RECORDED_NOW_S = 5.0
"""[s] since the last byte of a bag, within which it is being recorded: it grows faster."""
PASS_SCORE = 70.0
"""Pass line of curves where the scenes do not agree on one."""


def index_bags(store: AttemptStore, folder: Path) -> list[str]:
    """Add the bags of a folder that the index does not have, and note those that are gone.

    Returns:
        Sentences about bags that cannot be read.
    """
    store.mark_missing()
    # A bag that was not closed has no measures, and may have been repaired since.
    known = {row.bag for row in store.rows() if row.measures and row.state != 'bag is gone'}
    problems = []
    for metadata in sorted(folder.resolve().glob(f'*/{METADATA_FILE}')):
        bag = metadata.parent
        if str(bag) in known:
            continue
        try:
            row = attempt_of(bag, store)
        except (BagError, ValueError) as error:
            problems.append(f'{bag}: {" ".join(str(error).split())}')
            continue
        if row is not None:
            store.put([row])
    return problems


def attempt_of(folder: Path, store: AttemptStore) -> AttemptRow | None:
    """Return the attempt that a bag records, scored; None: its scene is no exercise.

    Raises:
        BagError: it is not a bag.
    """
    bag = open_bag(folder)
    scene = recorded(bag)
    if scene is None or not scene.exercise.title:
        return None
    data = bag.custom_data
    subject = ''.join(c if c.isprintable() else '?' for c in data.get('subject', 'unknown'))
    exercise = scene.name
    attempt = attempt_number(data.get('attempt', ''))
    row = AttemptRow(
        bag=str(folder),
        subject=subject,
        exercise=exercise,
        attempt=attempt or store.next_attempt(subject, exercise),
        begun=first_time(bag) * 1e-9,
        state='scored' if bag.complete else 'broken off',
        notes=data.get('notes', ''),
    )
    if not bag.complete:
        return row
    made = read_attempt(bag, scene.exercise)
    measures = made.measures()
    row = replace(row, measures={str(name): value for name, value in measures.items()})
    if made.broken_off:
        return replace(row, state='broken off')
    got = score(scene.exercise, measures)
    return replace(row, points=got.points, passed=got.passed, reasons=tuple(got.reasons))


def plain(row: AttemptRow) -> dict[str, Any]:
    """Return a row for JSON: NaN is null."""
    return asdict(row) | {'points': None if math.isnan(row.points) else row.points}


def list_table(rows: Sequence[AttemptRow]) -> Table:
    """Return the attempts as a table."""
    table = Table('begun (UTC)', 'subject', 'exercise', 'attempt', 'points', 'result')
    table.add_column('bag', overflow='fold')  # the name is what `--compare` takes
    for row in rows:
        begun = datetime.fromtimestamp(row.begun, UTC)
        name = Path(row.bag).name
        table.add_row(
            f'{begun:%Y-%m-%d %H:%M:%S}', escape(row.subject), escape(row.exercise),
            str(row.attempt), _points(row), _result(row), escape(name),
        )  # fmt: skip
    return table


def _result(row: AttemptRow) -> str:
    return ('passed' if row.passed else 'failed') if row.state == 'scored' else row.state


def _points(row: AttemptRow) -> str:
    return '' if math.isnan(row.points) else f'{row.points:.1f}'


def comparison_table(one: AttemptRow, two: AttemptRow) -> Table:
    """Return two attempts side by side, a row for each measure that one of them has."""
    table = Table('measure', escape(Path(one.bag).name), escape(Path(two.bag).name))
    table.add_row('exercise', escape(one.exercise), escape(two.exercise))
    table.add_row('points', _points(one), _points(two))
    table.add_row('result', _result(one), _result(two))
    for name in MEASURES:
        values = [row.measures.get(name, math.nan) for row in (one, two)]
        if not all(map(math.isnan, values)):
            table.add_row(UNITS[name][2], *(in_words(name, value) for value in values))
    return table


def chosen(store: AttemptStore, subject: str, exercise: str) -> list[AttemptRow]:
    """Return the attempts of a subject and at an exercise; '' is any.

    Raises:
        SessionError: there are attempts, but none of these.
    """
    rows = store.rows(subject, exercise)
    if not rows and (known := store.rows()):
        asked = ' and '.join(filter(None, (subject, exercise)))
        names = ', '.join(sorted({row.exercise for row in known}))
        raise SessionError(
            f'the index has no attempt of {asked!r}: it has the exercises {names}; `attempts` '
            'lists the subjects'
        )
    return rows


def find(rows: Sequence[AttemptRow], bag: str) -> AttemptRow:
    """Return the attempt of a bag, by the folder's name or path.

    Raises:
        SessionError: there is none.
    """
    path = str(Path(bag).resolve())
    named = [row for row in rows if row.bag == path or Path(row.bag).name == bag]
    if not named:
        raise SessionError(f'{bag} is no attempt in the index: `attempts` lists them')
    return named[0]


def curves_table(rows: Sequence[AttemptRow]) -> tuple[list[LearningCurve], Table]:
    """Return the learning curves, and the end of each as a table."""
    curves = learning_curves(rows, PASS_SCORE)
    table = Table('subject', 'exercise', 'attempts', 'last', 'average of 5', 'holds pass line from')
    for curve in curves:
        table.add_row(
            escape(curve.subject), escape(curve.exercise), str(len(curve.points)),
            f'{curve.points[-1]:.1f}', f'{curve.average[-1]:.1f}',
            str(curve.first_pass or 'not yet'),
        )  # fmt: skip
    return curves, table


def export_rows(rows: Sequence[AttemptRow], file: Path) -> None:
    """Write attempts with all measures, in SI units, as .csv or .parquet.

    Raises:
        SessionError: the name has another ending.
    """
    if file.suffix not in ('.csv', '.parquet'):
        raise SessionError(f'{file}: end its name in .csv or .parquet')
    heads = ('bag', 'subject', 'exercise', 'attempt', 'begun', 'state', 'points', 'passed', 'notes')
    columns: dict[str, list[Any]] = {name: [plain(row)[name] for row in rows] for name in heads} | {
        name: [row.measures.get(name) for row in rows] for name in MEASURES
    }
    if file.suffix == '.parquet':
        numbers = {name: pa.array(columns[name], pa.float64()) for name in ('points', *MEASURES)}
        pq.write_table(pa.table(columns | numbers), file)
        return
    with file.open('w', encoding='utf-8', newline='') as out:
        writer = csv.writer(out, lineterminator='\n')
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def delete(store: AttemptStore, folder: Path, subject: str) -> list[str]:
    """Delete a subject: the bags in the indexed folder, then rows of the index.

    Raises:
        SessionError: the index has no attempt of that subject, one is recorded now, or one is a
            link.
    """
    bags = [Path(row.bag) for row in store.rows(subject)]
    if not bags:
        raise SessionError(
            f'the index has no attempt of {subject!r}: `attempts` lists the subjects'
        )
    own = [bag for bag in bags if bag.parent == folder.resolve() and bag.is_dir()]
    if recorded_now := next(filter(_grows, own), None):
        raise SessionError(f'{recorded_now} is being recorded: end that session first')
    if link := next(filter(Path.is_symlink, own), None):
        raise SessionError(
            f'{link} is a link to {link.readlink()}: nothing is deleted; delete the bag there, and '
            'the link, first'
        )
    for bag in own:
        shutil.rmtree(bag)
    store.delete_subject(subject)
    return [str(bag) for bag in own]


def _grows(bag: Path) -> bool:
    """Return whether a bag that is not closed has been written to just now."""
    try:
        if open_bag(bag).complete:
            return False
    except BagError:
        return False
    newest = max(file.stat().st_mtime for file in bag.iterdir())
    return time.time() - newest < _RECORDED_NOW_S
