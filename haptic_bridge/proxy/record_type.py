"""Types of the structured records that kernels read by field."""

from typing import Any

import numpy as np
from numba import config


class _Fields(np.record):  # type: ignore[misc]  # final in its stubs only
    """A record with its fields as attributes, in Python too; a field `device` hides numpy's own."""

    def __getattribute__(self, name: str) -> Any:
        fields = np.void.__getattribute__(self, 'dtype').fields or {}
        return self[name] if name in fields else np.void.__getattribute__(self, name)

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value


def record_type(fields: Any) -> np.dtype[Any]:
    """Return the type of a record, also for kernels that run in Python (NUMBA_DISABLE_JIT=1).

    Args:
        fields: name, kind and shape of each, or the layout of all, as `np.dtype` takes them.
    """
    return np.dtype((_Fields, fields)) if config.DISABLE_JIT else np.dtype(fields)
