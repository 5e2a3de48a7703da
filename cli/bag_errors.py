"""Errors of commands that read a strange bag, as one sentence."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cutting_trainer.bags.errors import BagError
from cutting_trainer.node_common.rejections import MessageError

ROOT = Path(__file__).resolve().parents[1]
_OF_CONTENT = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError)


@contextmanager
def reading(bag: Path) -> Iterator[None]:
    """Turn an error about the content of a bag into one sentence that names the bag.

    Definitions and messages of a bag are whatever its maker liked. The sentence names the place in
    the code, for the case that the bag is right and the trainer is not.

    Raises:
        BagError: in the place of an error that is none of the user's.
    """
    try:
        yield
    except BagError:
        raise
    except (*_OF_CONTENT, ValueError) as error:
        if isinstance(error, ValueError) and not _is_of_content(error):
            raise
        raise BagError(
            f'{bag} cannot be used: its content is not that of a session '
            f'({type(error).__name__} in {_place(error)}: {" ".join(str(error).split())[:200]})'
        ) from error


def _is_of_content(error: ValueError) -> bool:
    """Return whether an error is of Python or of a message, and not a sentence of ours."""
    package = type(error).__module__.partition('.')[0]
    return isinstance(error, MessageError) or package not in ('cutting_trainer', 'pydantic')


def _place(error: BaseException) -> str:
    """Return the innermost of our lines that an error came through."""
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(str(ROOT))
    ]
    ours = [f for f in frames if '/site-packages/' not in f.filename]
    if not ours:
        return 'a library'
    return f'{Path(ours[-1].filename).relative_to(ROOT)}:{ours[-1].lineno}'
