"""Journal of a study: each computed row in one line, on disk before the next one counts."""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.designs import Key, Setting
from cutting_trainer.studies.evaluation import Result
from cutting_trainer.studies.identity import Identity

JOURNAL_FILE = 'rows.jsonl'


def key_of(bag_hash: str, setting: Setting) -> Key:
    """Return the key of a row, whatever the order of bags and settings."""
    return bag_hash, setting.identity


@dataclass
class Journal:
    """Rows that are done, in a file that only one study at a time writes.

    Attributes:
        path: the file.
        rows: results by key; those of other code are not among them.
        outdated: keys of rows that only other code has computed, or beside another reference.
    """

    path: Path
    rows: dict[Key, Result]
    outdated: set[Key]
    _descriptor: int

    def append(self, key: Key, result: Result) -> None:
        """Write a row, and wait until it is on disk.

        Raises:
            SessionError: it cannot be written.
        """
        line = json.dumps({'key': key, **asdict(result)}) + '\n'
        data = memoryview(line.encode())
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
            os.fsync(self._descriptor)
        except OSError as error:
            raise SessionError(
                f'{self.path} cannot be written ({error.strerror}): make room, and start the study '
                'again; it goes on with what is left'
            ) from None
        self.rows[key] = result


@contextlib.contextmanager
def open_journal(folder: Path, here: Identity, reference: str = '') -> Iterator[Journal]:
    """Open the journal of a folder of results, after removing a line that was cut off.

    Args:
        folder: exists.
        here: code whose rows count.
        reference: identity of the setting with which they are compared.

    Raises:
        SessionError: another process writes it, or it is no journal.
    """
    path = folder / JOURNAL_FILE
    with path.open('a+b') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SessionError(
                f'{path} is being written by another study: wait for it, or name another folder '
                'with --output'
            ) from None
        file.seek(0)
        whole, _, cut_off = file.read().rpartition(b'\n')
        if cut_off:
            file.truncate(len(whole) + 1 if whole else 0)
        rows: dict[Key, Result] = {}
        outdated: set[Key] = set()
        for number, line in enumerate(whole.splitlines(), start=1):
            key, result = _row(line, path, number)
            if here.differences(result.identity) or result.reference != reference:
                outdated.add(key)
            else:
                rows[key] = result
        yield Journal(path, rows, outdated - rows.keys(), file.fileno())


def _row(line: bytes, path: Path, number: int) -> tuple[Key, Result]:
    try:
        values: dict[str, Any] = json.loads(line)
        bag_hash, setting = values.pop('key')
        identity = Identity(**values.pop('identity'))
        return (bag_hash, setting), Result(identity=identity, **values)
    except (ValueError, TypeError, KeyError, AttributeError):
        raise SessionError(
            f'{path}:{number} is not a row of a study: move the file away, and the rows are '
            'computed again'
        ) from None
