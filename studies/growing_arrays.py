"""Arrays of an HDF5 file that grow by blocks, so that a session need not fit into memory."""

import errno
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cutting_trainer.session.errors import SessionError

_BLOCK_BYTES = 1 << 18
"""Largest part of an array in memory, and the size of a chunk in the file."""
_ROOM_BYTES = 64 << 20
"""Room on the disk below which nothing is written: on a full disk the HDF5 library may crash."""


class GrowingArray:
    """A compressed array that grows along its first axis.

    Args:
        group: where it is made.
        name: of it.
        dtype: of its numbers.
        shape: of a row.
        unit: SI unit; '1': a number without one.
        about: one sentence; '' where the name says it.
    """

    def __init__(
        self,
        group: h5py.Group,
        name: str,
        dtype: Any,
        shape: tuple[int, ...] = (),
        unit: str = '1',
        about: str = '',
    ) -> None:
        self._rows = _rows_of_block(np.dtype(dtype), shape)
        self._array = group.create_dataset(
            name, (0, *shape), dtype, maxshape=(None, *shape), chunks=(self._rows, *shape),
            compression='gzip', compression_opts=1, shuffle=True,
        )  # fmt: skip
        self._array.attrs['unit'] = unit
        if about:
            self._array.attrs['about'] = about
        self._block = np.empty((self._rows, *shape), dtype)
        self._digest = hashlib.blake2b(digest_size=16)
        self.name = str(self._array.name)
        self.length = 0

    def append(self, rows: Any) -> None:
        """Append rows, shape (n, ...); they are copied."""
        rows = np.ascontiguousarray(rows, self._block.dtype).reshape(-1, *self._block.shape[1:])
        self._digest.update(rows.data)
        while len(rows):
            begin = self.length % self._rows
            part, rows = np.split(rows, [self._rows - begin])
            self._block[begin : begin + len(part)] = part
            self.length += len(part)
            if self.length % self._rows == 0:
                self.flush()

    def flush(self) -> None:
        """Write the rows that wait.

        Raises:
            OSError: the disk is nearly full.
        """
        file = Path(self._array.file.filename)
        if shutil.disk_usage(file.parent).free < _ROOM_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
        first = max(self.length - 1, 0) // self._rows * self._rows
        self._array.resize(self.length, axis=0)
        self._array[first:] = self._block[: self.length - first]

    def digest(self) -> str:
        """Return the hash of all rows."""
        return self._digest.hexdigest()


class RaggedArray:
    """Blocks of rows of different lengths: row `offset[i]` to `offset[i + 1]` is block i.

    Args:
        group: where both arrays are made.
        offset: name of the offsets.
        arrays: whose blocks have equal lengths.
    """

    def __init__(self, group: h5py.Group, offset: str, *arrays: GrowingArray) -> None:
        names = ', '.join(array.name.rpartition('/')[2] for array in arrays)
        about = f'block i of {names} has the rows from offset[i] to before offset[i + 1]'
        self.offset = GrowingArray(group, offset, np.int64, about=about)
        self.offset.append([0])
        self._arrays = arrays

    def append(self, *blocks: NDArray[Any]) -> None:
        """Append a block to each array."""
        for array, block in zip(self._arrays, blocks, strict=True):
            array.append(block)
        self.offset.append([self._arrays[0].length])


def check_arrays(file: Path, digests: dict[str, str]) -> None:
    """Read arrays from a file and compare them with those that were written.

    Args:
        file: to read.
        digests: hash by name of the array.

    Raises:
        SessionError: one differs.
    """
    with h5py.File(file) as opened:
        for name, wanted in digests.items():
            digest = hashlib.blake2b(digest_size=16)
            for block in _blocks(opened[name]):
                digest.update(block.data)
            if digest.hexdigest() != wanted:
                raise SessionError(f'{file} has another {name} than its bag: the disk is at fault')


def _blocks(array: h5py.Dataset) -> Iterator[NDArray[Any]]:
    rows = _rows_of_block(array.dtype, array.shape[1:])
    for first in range(0, len(array), rows):
        yield np.ascontiguousarray(array[first : first + rows])


def _rows_of_block(dtype: np.dtype[Any], shape: tuple[int, ...]) -> int:
    return max(_BLOCK_BYTES // (dtype.itemsize * int(np.prod(shape))), 1)
