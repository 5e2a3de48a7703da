"""Bags at a URL, copied to this machine once; fsspec knows the protocols: file, ssh, s3, more."""

import contextlib
import fcntl
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from glob import has_magic
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.session.errors import SessionError

_HASH_DIGITS = 16


class UnavailableError(SessionError):
    """A bag or a mesh cannot be reached now, or from this worker."""


def is_url(place: str) -> bool:
    """Return whether a place is a URL, and no path."""
    return '://' in place


def bags_at(url: str) -> list[str]:
    """Return the URL of each bag in a folder or anywhere below it, or of those that a glob names.

    Raises:
        SessionError: the URL is none for bags.
        UnavailableError: the place cannot be reached, or its protocol needs a package.
    """
    files, root = _opened(url)
    start = url.rstrip('/').removesuffix(root)  # protocol, user and machine
    with _reaching(url):
        tops = files.glob(root) if has_magic(root) and not files.exists(root) else [root]
        found = [path for top in tops for path in files.find(top) if _is_of_bag(path)]
    folders = {path.rpartition('/')[0] for path in found}
    inner = {f for f in folders if any(f.startswith(f'{outer}/') for outer in folders)}
    return [f'{start}{folder}' for folder in sorted(folders - inner)]


def copied_bag(url: str) -> Path:
    """Return a copy of a bag, made where this machine lacks it; one that has changed is made anew.

    Raises:
        UnavailableError: the bag cannot be reached, or the copy cannot be written.
    """
    files, root = _opened(url)
    with _reaching(url):
        paths = sorted(path for path in files.ls(root, detail=False) if _is_of_bag(path))
        state = '\0'.join([url, *(_state(files.info(path)) for path in paths)])
    copies = _copies()
    key = hashlib.sha256(state.encode()).hexdigest()[:_HASH_DIGITS]
    copy = copies / key / PurePosixPath(root).name
    names = [PurePosixPath(path).name for path in paths]
    if not names:
        raise UnavailableError(f'{url}: there is no bag')
    with _reaching(url, f'copied to {copies}'):
        copies.mkdir(parents=True, exist_ok=True)
        with (copies / f'{key}.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # of workers that begin with the same bag, one copies
            if not all((copy / name).is_file() for name in names):
                shutil.rmtree(copy.parent, ignore_errors=True)
                with tempfile.TemporaryDirectory(dir=copies) as new:
                    whole = Path(new) / key / copy.name
                    whole.mkdir(parents=True)
                    files.get(paths, [str(whole / name) for name in names])
                    whole.parent.rename(copy.parent)
    return copy


def without_copies(text: str) -> str:
    """Return a text without the folders of copies, which are others on each machine."""
    return re.sub(rf'{re.escape(str(_copies()))}/[0-9a-f]{{{_HASH_DIGITS}}}/', '', text)


def _copies() -> Path:
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    return cache / 'cutting-trainer' / 'bags'


def _state(info: dict[str, Any]) -> str:
    """Return what changes with a file, as size and time, but not the time of its last access."""
    return repr(sorted((key, str(value)) for key, value in info.items() if key != 'time'))


def _is_of_bag(path: str) -> bool:
    return path.endswith(('.mcap', f'/{METADATA_FILE}'))


def _opened(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it."""
    with _reaching(url):
        from fsspec.core import url_to_fs

        if urlsplit(url).password:
            raise SessionError('leave the password out: results would have it; take a key')
        # Instances that are kept answer from old listings, and hold connections that have ended.
        files, root = url_to_fs(url.rstrip('/'), skip_instance_cache=True)
        if not url.rstrip('/').endswith(str(root)) or not str(root).strip('/'):
            raise SessionError('give the whole path of a folder, as file:///home/me/bags')
    return files, str(root)


@contextlib.contextmanager
def _reaching(url: str, purpose: str = 'reached') -> Iterator[None]:
    """Turn an error of any file system into a sentence."""
    try:
        yield
    except SessionError as error:
        raise SessionError(f'{url}: {error}') from None
    except ImportError as error:
        raise UnavailableError(
            f'{url}: {error}: add that package with `./trainer run python -m pip install`'
        ) from None
    except Exception as error:
        said = ' '.join(str(error).split()) or type(error).__name__
        raise UnavailableError(f'{url} cannot be {purpose}: {said}') from None
