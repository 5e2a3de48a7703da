"""Plans of earlier starts, by hash of all that they depend on, beside Numba's cache of kernels."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from cutting_trainer.node_common.code_identity import identity_here
from cutting_trainer.tissue_sim.planner.candidate import Task
from cutting_trainer.tissue_sim.planner.plan import Plan

_PLAN = TypeAdapter(Plan)


def recall(task: Task, note: Callable[[str], None]) -> Plan | None:
    """Return the plan of an earlier start, or None.

    Args:
        task: the scene.
        note: gets one sentence if there is none, or if its file is damaged.
    """
    file = _file(task)
    if file is None:
        return None
    try:
        checksum, _, text = file.read_bytes().partition(b'\n')
        if checksum == _hash(text).encode():
            return _PLAN.validate_json(text)
    except FileNotFoundError:
        note('no plan is known for this tissue, budget, code and processor: planned anew')
        return None
    except (OSError, ValidationError):
        pass
    note(f'{file} is not a plan any more: planned anew')
    return None


def remember(task: Task, found: Plan) -> None:
    """Keep a plan for later starts, where the launcher has a cache."""
    file = _file(task)
    if file is None:
        return
    text = _PLAN.dump_json(found)
    beside = file.with_suffix(f'.{os.getpid()}')
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(_hash(text).encode() + b'\n' + text)
        beside.replace(file)
    except OSError:  # a full or read-only disk: the next start plans anew
        beside.unlink(missing_ok=True)


def _file(task: Task) -> Path | None:
    cache = os.environ.get('NUMBA_CACHE_DIR')
    return Path(cache) / 'plans' / f'{_key(task)}.json' if cache else None


def _key(task: Task) -> str:
    """Return the hash of mesh, section, budget, code and processor."""
    mesh, code = task.mesh, identity_here()
    total = hashlib.sha256()
    for array in (mesh.rest, mesh.tetrahedra, mesh.fixed, mesh.regions):
        total.update(f'{array.dtype} {array.shape}\n'.encode() + array.tobytes())
    parts = (task.material, task.resistance, task.budget, task.stepping, task.model)
    libraries = (code.kernels, code.python, code.numba, code.numpy, code.cpu, code.features)
    processors = min(task.budget.threads, len(os.sched_getaffinity(0)))
    total.update(repr((parts, libraries, processors)).encode())
    return total.hexdigest()


def _hash(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()
