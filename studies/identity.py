"""Identity of a worker: code, kernels, libraries, machine."""

import hashlib
from dataclasses import dataclass, fields
from functools import cache
from importlib.metadata import version

from cutting_trainer.node_common.code_identity import hash_of_sources, identity_here
from cutting_trainer.node_common.share_folder import ROOMS, share_folder

CODE = ('node_common', 'bags', 'session', 'exercises', 'recordings', 'studies')
"""Packages that decide the numbers of a row beside those with kernels."""
_HASH_DIGITS = 16
_MACHINE = ('commit', 'cpu', 'target', 'features')
"""Fields in which workers of one study may differ; of these the last two decide the last bits."""


@dataclass(frozen=True)
class Identity:
    """Code and machine of a row.

    Attributes:
        commit: of the git repository; '' without one.
        code: hash of the sources of `CODE`.
        kernels: hash of the sources with kernels.
        devices: hash of the profiles of devices, which bound the force.
        python, numba, llvmlite, numpy, scipy, meshio: versions.
        cpu: model name of the processor.
        target: processor by the name that LLVM gives it.
        features: instructions that kernels are compiled for, comma-separated.
    """

    commit: str
    code: str
    kernels: str
    python: str
    numba: str
    llvmlite: str
    numpy: str
    cpu: str
    target: str
    features: str
    scipy: str = ''
    meshio: str = ''
    devices: str = ''

    def differences(self, worker: 'Identity') -> list[str]:
        """Return a sentence for each difference of code or libraries, not of the machine."""
        return [
            f'{field.name} is {getattr(worker, field.name) or "unknown"} on the worker, '
            f'and {getattr(self, field.name) or "unknown"} here'
            for field in fields(self)
            if field.name not in _MACHINE
            and getattr(self, field.name) != getattr(worker, field.name)
        ]

    @property
    def processor(self) -> tuple[str, str]:
        """Kind of processor: rows of one kind are the same to the bit."""
        return self.target, self.features


@cache
def identity_of_worker() -> Identity:
    """Return the identity of this process; computed once."""
    here = identity_here()
    return Identity(
        commit=here.commit,
        code=hash_of_sources(ROOMS / name for name in CODE)[:_HASH_DIGITS],
        kernels=here.kernels[:_HASH_DIGITS],
        python=here.python,
        numba=here.numba,
        llvmlite=here.llvmlite,
        numpy=here.numpy,
        cpu=here.cpu,
        target=here.target,
        features=here.features,
        scipy=version('scipy'),
        meshio=version('meshio'),
        devices=_hash_of_profiles(),
    )


def _hash_of_profiles() -> str:
    files = sorted((share_folder() / 'config' / 'devices').glob('*.yaml'))
    text = b''.join(file.name.encode() + file.read_bytes() for file in files)
    return hashlib.sha256(text).hexdigest()[:_HASH_DIGITS]
