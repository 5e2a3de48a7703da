"""Time from the start of a node's process until it is ready."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.common.clock import Figure, figure
from cutting_trainer.node_common.share_folder import SCENES
from cutting_trainer.session.domain import reserved_domain
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.node_commands import (
    MODULES,
    RECORDER_NODE,
    node_command,
    node_environment,
    recorder_command,
)
from cutting_trainer.session.node_process import NodeCommand
from cutting_trainer.session.supervisor import Supervisor

_REFERENCE = 'Python with numba'


def start(repeats: int = 5) -> list[Figure]:
    """Return each node by itself, alone in its domain, kernels from their cache: wall-clock time.

    Raises:
        SessionError: a node did not become ready.
    """
    scene = SCENES / 'liver.yaml'
    times: dict[str, list[float]] = {_REFERENCE: [], **{name: [] for name in MODULES}}
    with reserved_domain('free') as domain, tempfile.TemporaryDirectory() as folder:
        environment, log = node_environment(domain), Path(folder, 'log')
        for number in range(repeats + 1):
            began = time.monotonic()
            subprocess.run([sys.executable, '-c', 'import numba'], check=True)
            times[_REFERENCE].append(time.monotonic() - began)
            for name in MODULES:
                if name == RECORDER_NODE:
                    command = recorder_command(scene, Path(folder, f'bag{number}'), 0)
                else:
                    command = node_command(name, {'scene': str(scene)})
                times[name].append(_until_ready(command, log, environment))
    base = float(np.median(times[_REFERENCE][1:]))  # the first may compile
    return [
        figure(name, 's', np.array(took[1:]), float(np.median(took[1:])) / base, _REFERENCE)
        for name, took in times.items()
    ]


def _until_ready(command: NodeCommand, log: Path, environment: dict[str, str]) -> float:
    began = time.monotonic()
    with Supervisor([command], log, environment) as supervisor:
        ready = supervisor.start()
        took = time.monotonic() - began
        outcome = supervisor.end()
    if not ready:
        raise SessionError('; '.join(outcome.troubles))
    return took
