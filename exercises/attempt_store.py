"""Local index of attempts: an SQLite file that points at bags and can be made anew from them."""

import json
import math
import secrets
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

STATES = ('scored', 'broken off', 'bag is gone', 'not scored')
_SCHEMA = """
CREATE TABLE IF NOT EXISTS attempts (
  bag TEXT PRIMARY KEY, subject TEXT NOT NULL, exercise TEXT NOT NULL, attempt INTEGER NOT NULL,
  begun REAL NOT NULL, state TEXT NOT NULL, points REAL, passed INTEGER NOT NULL,
  notes TEXT NOT NULL, reasons TEXT NOT NULL, measures TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS by_subject ON attempts (subject, exercise, begun);
"""
_PSEUDONYM_BYTES = 3
SUBJECT = r'^[A-Za-z0-9_.-]*$'
"""Pattern of pseudonyms."""
MAX_ATTEMPT = 10**9
"""Largest number of an attempt."""


@dataclass(frozen=True)
class AttemptRow:
    """One attempt.

    Attributes:
        bag: folder of its bag.
        subject: pseudonym.
        exercise: name of the scene.
        attempt: number of the attempt of this subject at this exercise, from 1.
        begun: [s since the epoch].
        state: one of `STATES`.
        points: score of 100; NaN where it has none.
        passed: whether it passed.
        notes: of the session.
        reasons: sentences about lost points.
        measures: in SI units, by name; NaN left out.
    """

    bag: str
    subject: str
    exercise: str
    attempt: int
    begun: float
    state: str
    points: float = math.nan
    passed: bool = False
    notes: str = ''
    reasons: tuple[str, ...] = ()
    measures: dict[str, float] = field(default_factory=dict)


def attempt_number(text: str) -> int:
    """Return the number of an attempt that a bag names; 0: none.

    Raises:
        ValueError: it is larger than an attempt can be.
    """
    number = int(text) if text.isdecimal() else 0
    if number > MAX_ATTEMPT:
        raise ValueError(f'its attempt {number} is above {MAX_ATTEMPT}')
    return number


def new_pseudonym() -> str:
    """Return a subject that says nothing about a person, as `subject-3fa9c1`."""
    return f'subject-{secrets.token_hex(_PSEUDONYM_BYTES)}'


class AttemptStore:
    """The index, in one file.

    Args:
        file: made where there is none; its folder too.

    Raises:
        sqlite3.DatabaseError: the file is no index, is damaged, or cannot be opened.
    """

    def __init__(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        self._file = file
        with closing(self._connect()) as connection:
            connection.executescript(_SCHEMA)
            columns = [each['name'] for each in connection.execute('PRAGMA table_info(attempts)')]
            if columns != [each.name for each in fields(AttemptRow)]:
                raise sqlite3.DatabaseError('its table has other columns')
            (found,) = connection.execute('PRAGMA quick_check(1)').fetchone()
            if found != 'ok':
                raise sqlite3.DatabaseError(found)

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._file)
        connection.row_factory = sqlite3.Row
        connection.execute('PRAGMA secure_delete = ON')  # a deleted subject leaves no bytes
        return connection

    def put(self, rows: Iterable[AttemptRow]) -> None:
        """Write attempts in one transaction; those of the same bag are replaced."""
        values = [_plain(row) for row in rows]
        with closing(self._connect()) as connection, connection:
            marks = ', '.join('?' * 11)
            connection.executemany(f'INSERT OR REPLACE INTO attempts VALUES ({marks})', values)

    def rows(self, subject: str = '', exercise: str = '', state: str = '') -> list[AttemptRow]:
        """Return attempts in the order of their begin; empty filters let all through."""
        wanted = {'subject': subject, 'exercise': exercise, 'state': state}
        given = {key: value for key, value in wanted.items() if value}
        where = ' AND '.join(f'{key} = ?' for key in given) or '1'
        query = f'SELECT * FROM attempts WHERE {where} ORDER BY begun, bag'
        with closing(self._connect()) as connection:
            return [_row(each) for each in connection.execute(query, tuple(given.values()))]

    def bags(self) -> set[str]:
        """Return the folders of all bags in the index."""
        with closing(self._connect()) as connection:
            return {bag for (bag,) in connection.execute('SELECT bag FROM attempts')}

    def next_attempt(self, subject: str, exercise: str) -> int:
        """Return the number of the subject's next attempt at an exercise."""
        query = 'SELECT MAX(attempt) FROM attempts WHERE subject = ? AND exercise = ?'
        with closing(self._connect()) as connection:
            (last,) = connection.execute(query, (subject, exercise)).fetchone()
        return (last or 0) + 1

    def mark_missing(self) -> list[str]:
        """Note which bags are gone, and return their folders."""
        gone = [
            row.bag
            for row in self.rows()
            if row.state != 'bag is gone' and not Path(row.bag).is_dir()
        ]
        with closing(self._connect()) as connection, connection:
            connection.executemany(
                "UPDATE attempts SET state = 'bag is gone' WHERE bag = ?", [(bag,) for bag in gone]
            )
        return gone

    def delete_subject(self, subject: str) -> list[str]:
        """Delete all attempts of a subject from the index; return the folders of their bags."""
        bags = [row.bag for row in self.rows(subject)]
        with closing(self._connect()) as connection:
            with connection:
                connection.execute('DELETE FROM attempts WHERE subject = ?', (subject,))
            connection.execute('VACUUM')
        return bags


def _plain(row: AttemptRow) -> tuple[Any, ...]:
    values = asdict(row)
    values['points'] = None if math.isnan(row.points) else row.points
    values['reasons'] = json.dumps(row.reasons)
    finite = {name: value for name, value in row.measures.items() if math.isfinite(value)}
    values['measures'] = json.dumps(finite)
    return tuple(values.values())


def _row(each: sqlite3.Row) -> AttemptRow:
    values = dict(each)
    values['points'] = math.nan if values['points'] is None else values['points']
    values['passed'] = bool(values['passed'])
    values['reasons'] = tuple(json.loads(values['reasons']))
    values['measures'] = json.loads(values['measures'])
    return AttemptRow(**values)


WINDOW = 5
"""Attempts of the moving average."""


@dataclass(frozen=True)
class LearningCurve:
    """Scores of one subject at one exercise.

    Attributes:
        attempts: numbers of the scored attempts.
        points: their scores.
        average: mean of the last `WINDOW` scores up to each.
        first_pass: number of the first attempt that passed and from which the average stays at the
            pass line or above; None: there is none.
    """

    subject: str
    exercise: str
    attempts: tuple[int, ...]
    points: tuple[float, ...]
    average: tuple[float, ...]
    first_pass: int | None


def learning_curves(rows: Sequence[AttemptRow], pass_score: float) -> list[LearningCurve]:
    """Return a curve for each subject and exercise, sorted by both.

    Args:
        rows: attempts in order; those without a score are left out.
        pass_score: the pass line.
    """
    by: dict[tuple[str, str], list[AttemptRow]] = {}
    for row in rows:
        if not math.isnan(row.points):
            by.setdefault((row.subject, row.exercise), []).append(row)
    curves = []
    for (subject, exercise), own in sorted(by.items()):
        points = [row.points for row in own]
        average = [
            math.fsum(points[max(0, i + 1 - WINDOW) : i + 1]) / min(i + 1, WINDOW)
            for i in range(len(points))
        ]
        below = [i for i, value in enumerate(average) if value < pass_score]
        start = below[-1] + 1 if below else 0
        passed = (row.attempt for row in own[start:] if row.passed)
        curves.append(
            LearningCurve(
                subject,
                exercise,
                tuple(row.attempt for row in own),
                tuple(points),
                tuple(average),
                next(passed, None),
            )
        )
    return curves
