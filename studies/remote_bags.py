"""Bags at a URL, copied to this machine once; fsspec knows the protocols: file, ssh, s3, more."""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from glob import has_magic
from pathlib import Path, PurePosixPath
from typing import Any

from cutting_trainer.bags.metadata import METADATA_FILE
from cutting_trainer.session.errors import SessionError


class UnavailableError(SessionError):
    """A bag or a mesh cannot be reached now, or from this worker."""


def is_url(place: str) -> bool:
    """Return whether a place is a URL, and no path."""
    return '://' in place


def bags_at(url: str) -> list[str]:
    """Return the URL of each bag in a folder or anywhere below it, or of those that a glob names.

    Raises:
        UnavailableError: the place cannot be reached, or its protocol needs a package.
    """
    files, root = _opened(url)
    start = url.rstrip('/').removesuffix(root)  # protocol, user and machine
    with _reaching(url):
        tops = files.glob(root) if has_magic(root) else [root]
        found = [PurePosixPath(path) for top in tops for path in files.find(top)]
    folders = {p.parent for p in found if p.name == METADATA_FILE or p.suffix == '.mcap'}
    return [f'{start}{folder}' for folder in sorted(folders)]


def copied_bag(url: str) -> Path:
    """Return a copy of a bag, made where the cache lacks it; a bag that has changed is copied anew.

    Raises:
        UnavailableError: the bag cannot be reached, or the copy cannot be written.
    """
    files, root = _opened(url)
    with _reaching(url):
        paths = [path for path in files.ls(root, detail=False) if _is_of_bag(path)]
        state = '\0'.join([url, *(_state(files.info(path)) for path in sorted(paths))])
        cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
        copies = cache / 'cutting-trainer' / 'bags'
        copy = copies / hashlib.sha256(state.encode()).hexdigest()[:16] / PurePosixPath(root).name
        if not copy.is_dir():
            copies.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=copies) as new:
                whole = Path(new) / 'bag' / copy.name
                whole.mkdir(parents=True)
                files.get(paths, [str(whole / PurePosixPath(path).name) for path in paths])
                with contextlib.suppress(OSError):  # another worker was faster
                    whole.parent.rename(copy.parent)
    return copy


def _state(info: dict[str, Any]) -> str:
    """Return what changes with a file, as size and time, but not the time of its last access."""
    return repr(sorted((key, str(value)) for key, value in info.items() if key != 'time'))


def _is_of_bag(path: str) -> bool:
    return path.endswith(('.mcap', f'/{METADATA_FILE}'))


def _opened(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it."""
    with _reaching(url):
        from fsspec.core import url_to_fs

        files, root = url_to_fs(url.rstrip('/'))
    return files, str(root)


@contextlib.contextmanager
def _reaching(url: str) -> Iterator[None]:
    """Turn an error of any file system into a sentence."""
    try:
        yield
    except ImportError as error:
        raise UnavailableError(
            f'{url}: {error}: add that package with `./trainer run python -m pip install`'
        ) from None
    except Exception as error:
        said = ' '.join(str(error).split()) or type(error).__name__
        raise UnavailableError(f'{url} cannot be reached: {said}') from None
