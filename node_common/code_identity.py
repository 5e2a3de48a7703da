"""Identity of the code that computes: trainer, libraries, and the processor it is compiled for.

Equal identities give equal bits. The module imports neither ROS nor Numba.
"""

import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from xml.etree import ElementTree

from llvmlite import binding

from cutting_trainer.node_common.share_folder import PACKAGES, ROOMS, share_folder

KERNELS = ('tissue_sim', 'cutting', 'haptic_bridge')
"""Packages whose kernels decide the numbers of a session."""
PREFIX = 'code_'
"""Prefix of the keys in a bag's metadata."""
_GIT_TIMEOUT_S = 5.0
_HASH_DIGITS = 12


@dataclass(frozen=True)
class CodeIdentity:
    """The code that computed a session; an unknown part is an empty string.

    Attributes:
        version: of the trainer.
        commit: of the git repository, with '+' if tracked files were changed; '' without a
            repository.
        kernels: hash of the sources of `KERNELS`.
        python, numba, llvmlite, numpy: versions.
        cpu: model name of the processor.
        target: processor by the name that LLVM gives it.
        features: instructions that kernels are compiled for, comma-separated.
    """

    version: str = ''
    commit: str = ''
    kernels: str = ''
    python: str = ''
    numba: str = ''
    llvmlite: str = ''
    numpy: str = ''
    cpu: str = ''
    target: str = ''
    features: str = ''

    def flat(self) -> dict[str, str]:
        """Return keys and values as stored in a bag; unknown parts are left out."""
        return {f'{PREFIX}{key}': text for key, text in asdict(self).items() if text}

    @property
    def sentence(self) -> str:
        """Return the identity in a few words for a report."""
        commit = (
            f' ({self.commit[:_HASH_DIGITS]}{"+" * self.commit.endswith("+")})'
            if self.commit
            else ''
        )
        return (
            f'trainer {self.version}{commit}, kernels {self.kernels[:_HASH_DIGITS]}, '
            f'Python {self.python}, Numba {self.numba}, NumPy {self.numpy}, {self.cpu}'
        )

    def differences(self, here: 'CodeIdentity') -> list[str]:
        """Return one sentence for each difference between this code, recorded in a bag, and the
        present code.

        Args:
            here: the code of this process.
        """
        found = []
        if self.kernels != here.kernels:
            found.append(
                f"the trainer's own kernels have changed: bag {self._code()}, here {here._code()}"
            )
        for name in ('numba', 'llvmlite', 'numpy', 'python'):
            then, now = getattr(self, name), getattr(here, name)
            if then != now:
                found.append(f'{_WORDS[name]} has another version: bag {then}, here {now}')
        if not self.is_of_processor_of(here):
            found.append(f'the processor is another one: bag {self._processor(here)}')
        return found

    def is_of_processor_of(self, here: 'CodeIdentity') -> bool:
        """Return whether both are compiled for the same kind of processor."""
        return (self.target, self.features) == (here.target, here.features)

    def rounds_otherwise_only(self, here: 'CodeIdentity') -> bool:
        """Return whether the processor or libraries differ, but not the trainer's own code."""
        return self.kernels == here.kernels and bool(self.differences(here))

    def _code(self) -> str:
        commit = f' of commit {self.commit[:_HASH_DIGITS]}' if self.commit else ''
        changed = ' with changes' if self.commit.endswith('+') else ''
        return f'{self.kernels[:_HASH_DIGITS]}{commit}{changed}'

    def _processor(self, here: 'CodeIdentity') -> str:
        names = f'{self.cpu} ({self.target}), here {here.cpu} ({here.target})'
        then, now = set(self.features.split(',')), set(here.features.split(','))
        if self.target == here.target and then != now:
            names += f'; instructions: {", ".join(sorted(then ^ now))}'
        return names


_WORDS = {'numba': 'Numba', 'llvmlite': 'llvmlite', 'numpy': 'NumPy', 'python': 'Python'}


def identity_of(data: Mapping[str, object]) -> CodeIdentity | None:
    """Return the code that a bag or node names, or None if it names none.

    Args:
        data: values by key, keys as in `CodeIdentity.flat`; others are ignored.
    """
    named = {f.name: str(data.get(PREFIX + f.name, '')) for f in fields(CodeIdentity)}
    return CodeIdentity(**named) if named['kernels'] else None


@cache
def identity_here() -> CodeIdentity:
    """Return the code of this process; computed once."""
    return CodeIdentity(
        version=trainer_version(),
        commit=_commit(PACKAGES),
        kernels=hash_of_sources(ROOMS / name for name in KERNELS),
        python=platform.python_version(),
        **{name: _version(name) for name in ('numba', 'llvmlite', 'numpy')},
        cpu=_model_name(),
        target=os.environ.get('NUMBA_CPU_NAME') or binding.get_host_cpu_name(),
        features=_features(),
    )


def hash_of_sources(folders: Iterable[Path]) -> str:
    """Return the hash of names and bytes of all Python files in some folders, in hexadecimal."""
    total = hashlib.sha256()
    for folder in folders:
        for file in sorted(folder.rglob('*.py')):
            name = f'{folder.name}/{file.relative_to(folder).as_posix()}'
            total.update(f'{name}\n{hashlib.sha256(file.read_bytes()).hexdigest()}\n'.encode())
    return total.hexdigest()


def trainer_version() -> str:
    """Return the version of the package, or '' without its manifest."""
    manifest = share_folder() / 'package.xml'
    return ElementTree.parse(manifest).findtext('version', '') if manifest.is_file() else ''


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ''


def _commit(checkout: Path) -> str:
    """Return the commit of a checkout, with '+' if tracked files were changed; '' without one."""
    if not (checkout / '.git').exists():
        return ''
    try:
        commit = _git(checkout, 'rev-parse', 'HEAD')
        changed = _git(checkout, 'status', '--porcelain', '--untracked-files=no')
    except (OSError, subprocess.SubprocessError):
        return ''
    return commit + '+' * bool(changed)


def _git(checkout: Path, *words: str) -> str:
    command = ['git', '-C', str(checkout), '--no-optional-locks', *words]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=_GIT_TIMEOUT_S
    )
    return done.stdout.strip()


def _model_name() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    except OSError:
        return platform.machine()
    named = (line.partition(':')[2].strip() for line in lines if line.startswith('model name'))
    return next(named, platform.machine())


def _features() -> str:
    """Return the instructions that Numba compiles for: the processor's, unless the environment sets
    others.
    """
    given = os.environ.get('NUMBA_CPU_FEATURES')
    if given is None and os.environ.get('NUMBA_CPU_NAME') not in (None, 'host'):
        return ''
    flat = given if given is not None else binding.get_host_cpu_features().flatten()
    return ','.join(sorted(word[1:] for word in flat.split(',') if word.startswith('+')))
