"""Newest values for all pages, and the record of those that a page has received."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

KINDS = ('outer', 'cut')
NO_POSITIONS: NDArray[np.float32] = np.zeros((0, 3), np.float32)


@dataclass(frozen=True, eq=False)
class TissueFrame:
    """A tissue at one moment, in the form of its message; its arrays are never written to.

    Attributes:
        name: of the tissue.
        revision: counts frames.
        faces_revision: counts changes of the faces.
        positions: of each part's nodes [m], shape (n, 3), outer part first.
        faces: of each part, indices into its positions, shape (m, 3).
        cut_edges: ends of the edges along the cuts [m], shape (k, 3).
        rest: x and y of the outer part's nodes at rest [m], shape (n, 2).
    """

    name: str
    revision: int
    faces_revision: int
    positions: tuple[NDArray[np.float32], ...]
    faces: tuple[NDArray[np.uint32], ...]
    cut_edges: NDArray[np.float32] = field(default_factory=lambda: NO_POSITIONS)
    rest: NDArray[np.float32] = field(default_factory=lambda: NO_POSITIONS[:, :2])

    @cached_property
    def whole(self) -> bytes:
        """Return the message with faces."""
        return self._encoded(with_faces=True)

    @cached_property
    def moved(self) -> bytes:
        """Return the message without faces, for pages that have them."""
        return self._encoded(with_faces=False)

    def _encoded(self, *, with_faces: bool) -> bytes:
        parts = [
            {'kind': kind, 'vertices': len(at), 'faces': len(faces) if with_faces else None}
            for kind, at, faces in zip(KINDS, self.positions, self.faces, strict=True)
        ]
        header = {'type': 'mesh', 'name': self.name, 'revision': self.revision}
        rest = self.rest if with_faces else self.rest[:0]
        counts = {'cut_edges': len(self.cut_edges), 'rest': len(rest)}
        text = json.dumps(header | {'parts': parts} | counts).encode()
        text += b' ' * (-len(text) % 4)
        pieces = [len(text).to_bytes(4, 'little'), text]
        for at, faces in zip(self.positions, self.faces, strict=True):
            pieces.append(np.ascontiguousarray(at, '<f4').tobytes())
            if with_faces:
                pieces.append(np.ascontiguousarray(faces, '<u4').tobytes())
        pieces += [np.ascontiguousarray(last, '<f4').tobytes() for last in (self.cut_edges, rest)]
        return b''.join(pieces)


class ReceivedVersions:
    """Values that one page has received: versions by key, faces by tissue."""

    def __init__(self) -> None:
        self.versions: dict[str, int] = {}
        self.faces: dict[str, int] = {}


class PageState:
    """The newest value by key. It belongs to one thread: no other may use it.

    A slow page gets the newest value at the time of sending; values between are dropped. Therefore
    memory does not grow with the slowness of pages.
    """

    def __init__(self) -> None:
        self._values: dict[str, tuple[int, str | TissueFrame]] = {}
        self._version = 0

    def put(self, key: str, value: str | TissueFrame) -> bool:
        """Set a value; return whether it differs from the one before."""
        if isinstance(value, str) and key in self._values and self._values[key][1] == value:
            return False
        self._version += 1
        self._values[key] = self._version, value
        return True

    def due(self, seen: ReceivedVersions) -> Iterator[str | bytes]:
        """Yield each message that a page has not received, and mark it as received.

        Values are read when they are yielded: the newest one is sent.
        """
        for key in list(self._values):
            version, value = self._values[key]
            if seen.versions.get(key) == version:
                continue
            seen.versions[key] = version
            if isinstance(value, str):
                yield value
                continue
            known = seen.faces.get(key) == value.faces_revision
            seen.faces[key] = value.faces_revision
            yield value.moved if known else value.whole

    def has(self, seen: ReceivedVersions) -> bool:
        """Return whether a page has received every value."""
        return all(seen.versions.get(key) == version for key, (version, _) in self._values.items())
