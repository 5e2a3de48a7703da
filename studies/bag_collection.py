"""Bags of a study, found by path, folder, glob or URL."""

import glob
import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.node_common.scene_reader import missing_file
from cutting_trainer.recordings.attempts_command import index_bags
from cutting_trainer.session.attempts import open_store
from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.remote_bags import (
    UnavailableError,
    bags_at,
    copied_bag,
    is_url,
)

_BLOCK_BYTES = 1 << 20
_HASH_DIGITS = 16
_MAX_NAMES = 10
"""Names in a sentence."""


@dataclass(frozen=True)
class StudyBag:
    """A bag of a study.

    Attributes:
        name: path as the study file has it, or below the folder that it names.
        path: absolute path, of the copy where the bag is at a URL.
        hash: hash of its content.
        url: where it is; '' for a path.
    """

    name: str
    path: Path
    hash: str
    url: str = ''

    @property
    def place(self) -> str:
        """URL or path: where each worker finds it."""
        return self.url or str(self.path)


def find_bags(patterns: Iterable[str], folder: Path) -> list[StudyBag]:
    """Return the bags of a study, each content once, in the order of the patterns.

    Args:
        patterns: bags, folders with bags anywhere below, globs, or URLs of these.
        folder: to which relative ones are relative.

    Raises:
        SessionError: a pattern finds no bag.
    """
    found: dict[str, StudyBag] = {}
    for pattern in patterns:
        bags = _bags_at(pattern) if is_url(pattern) else _bags_by(pattern, folder)
        for bag in bags:
            found.setdefault(bag.hash, bag)
    return list(found.values())


def folder_of(place: str) -> Path:
    """Return the folder of a bag; one at a URL is copied first.

    Raises:
        UnavailableError: it is not there.
    """
    if is_url(place):
        return copied_bag(place)
    require(Path(place))
    return Path(place)


def require(path: Path) -> None:
    """Refuse a bag or a mesh that is not there.

    Raises:
        UnavailableError: it is not there.
    """
    if not path.exists():
        raise UnavailableError(f'{path} is not there on this worker: give all the same folders')


def _bags_at(url: str) -> Iterator[StudyBag]:
    places = bags_at(url)
    if not places:
        raise SessionError(f'{url}: there is no bag, no folder with metadata.yaml or an .mcap file')
    for place in places:
        path = copied_bag(place)
        yield StudyBag(place, path, hash_of_bag(path), place)


def find_attempts(folder: Path, subject: str, exercise: str) -> tuple[list[str], list[str]]:
    """Return the bags of scored attempts, and sentences about bags that cannot be read.

    Args:
        folder: of the bags and their index, which is brought up to date.
        subject: only this one; '': every one.
        exercise: only this one; '': every one.

    Raises:
        SessionError: there are none.
    """
    if not folder.is_dir():
        raise SessionError(f'attempts: {missing_file(folder)}')
    store = open_store(folder)
    problems = index_bags(store, folder)
    if rows := store.rows(subject, exercise, 'scored'):
        # Brackets in a name are no pattern.
        return [glob.escape(row.bag) for row in rows], problems
    known = store.rows(state='scored')
    wanted = {'exercise': exercise, 'subject': subject}
    said = ' and '.join(f'{key} {value}' for key, value in wanted.items() if value)
    there = [
        f'{key}s {", ".join(names)}'
        for key, value in wanted.items()
        if value and (names := sorted({getattr(row, key) for row in known})[:_MAX_NAMES])
    ]
    raise SessionError(
        f'attempts: {folder} has no scored attempt{f" of {said}" if said else ""}'
        + (f': it has {"; ".join(there)}' if there else ': record one with `./trainer view`')
    )


def _bags_by(pattern: str, folder: Path) -> Iterator[StudyBag]:
    try:
        whole = folder / Path(pattern).expanduser()
    except RuntimeError as error:  # there is no such user
        raise SessionError(f'{pattern}: {error}') from None
    # A name with brackets is a name, too. Path.glob takes no absolute pattern.
    found = [str(whole)] if whole.exists() else sorted(glob.glob(str(whole), recursive=True))  # noqa: PTH207
    matches = [Path(match) for match in found]
    bags = [bag for match in matches if match.is_dir() for bag in _bags_below(match)]
    if not bags:
        if all(match.suffix == '.mcap' for match in matches) and matches:
            reason = 'a bag is the folder of its .mcap file: name that'
        elif matches:
            reason = 'there is no bag in it, no folder with metadata.yaml or an .mcap file'
        elif glob.has_magic(pattern):
            reason = 'no file matches it'
        else:
            reason = missing_file(whole)
        raise SessionError(f'{pattern}: {reason}')
    for bag in dict.fromkeys(bags):
        yield StudyBag(_name(bag, folder), bag, hash_of_bag(bag))


def _bags_below(folder: Path) -> list[Path]:
    """Return a folder if it is a bag, else all bags anywhere below it."""
    if _is_bag(folder):
        return [folder]
    return [bag for part in sorted(folder.iterdir()) if part.is_dir() for bag in _bags_below(part)]


def _is_bag(folder: Path) -> bool:
    return (folder / METADATA_FILE).is_file() or any(folder.glob('*.mcap'))


def _name(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def hash_of_bag(folder: Path) -> str:
    """Return the hash of names and bytes of a bag's files: its metadata and its data."""
    total = hashlib.sha256()
    for path in sorted([folder / METADATA_FILE, *folder.glob('*.mcap')]):
        if path.is_file():
            total.update(f'{path.name}\0{path.stat().st_size}\0'.encode())
            with path.open('rb') as file:
                while block := file.read(_BLOCK_BYTES):
                    total.update(block)
    return total.hexdigest()[:_HASH_DIGITS]
