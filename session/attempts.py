"""Who makes an attempt, and which one it is, for the bag of a session."""

import sqlite3
from contextlib import suppress
from pathlib import Path

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.exercises.attempt_store import (
    MAX_ATTEMPT,
    AttemptStore,
    attempt_number,
    new_pseudonym,
)
from cutting_trainer.session.errors import SessionError

STORE_FILE = 'attempts.sqlite'
_NO_INDEX = (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR)
"""Errors of a file with other content; those of disk and permissions are not among them."""


def open_store(folder: Path) -> AttemptStore:
    """Return the index of a folder of bags.

    Raises:
        SessionError: its file is no index, is in use, or cannot be opened.
    """
    file = folder.resolve() / STORE_FILE
    try:
        return AttemptStore(file)
    except sqlite3.DatabaseError as error:
        code = getattr(error, 'sqlite_errorcode', sqlite3.SQLITE_NOTADB)
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise SessionError(
                f'{file} is in use by another program: start again when that is done'
            ) from None
        if file.is_dir() or code not in _NO_INDEX:
            raise SessionError(
                f'{file} cannot be opened or written ({error}): check that it is a file, its '
                'permissions and the disk'
            ) from None
        raise SessionError(
            f'{file} is no index of attempts: delete it, and it is made anew from the bags'
        ) from None


def attempt_data(folder: Path, exercise: str, subject: str, notes: str) -> dict[str, str]:
    """Return the entries of an attempt in its bag.

    Args:
        folder: where the bag goes.
        exercise: name of the scene.
        subject: pseudonym; empty: a new one.
        notes: remarks on the session.

    Raises:
        SessionError: the folder has a file in place of its index.
    """
    number = next_attempt(folder, subject, exercise) if subject else 1
    return {'subject': subject or new_pseudonym(), 'attempt': str(number), 'notes': notes}


def next_attempt(folder: Path, subject: str, exercise: str) -> int:
    """Return the number of a subject's next attempt, by the index and the bags beside it.

    Args:
        folder: of the bags.
        subject: pseudonym.
        exercise: name of the scene.
    """
    store = open_store(folder)
    known = store.bags()
    last = store.next_attempt(subject, exercise) - 1
    for metadata in folder.resolve().glob(f'*/{METADATA_FILE}'):
        if str(metadata.parent) in known:
            continue
        try:
            data = open_bag(metadata.parent).custom_data
        except BagError:
            continue  # `attempts` names it
        if data.get('subject') == subject and Path(data.get('scene_file', '')).stem == exercise:
            with suppress(ValueError):
                last = max(last, attempt_number(data.get('attempt', '')))
    return min(last + 1, MAX_ATTEMPT)
