"""A copy of the checkout in which faults are planted, and its tests run.

The copy shares the environment of the checkout. Numba finds its compiled kernels by the folder,
the time and the size of a source file, so each fault has a cache of hard links to the checkout's,
without the faulty kernel and those that call it.
"""

import hashlib
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from bench.faults.candidates import ROOMS, Fault
from bench.faults.suspects import affected_functions

_SCRATCH_TIME = 1_000_000_000
"""[s] since the epoch: a planted file has a time of its own, so that nothing takes it for the sound
one."""


@dataclass(frozen=True)
class Outcome:
    """The result of a run of tests.

    Attributes:
        failed: the first test that failed, or was running when a limit ended the run; None: none.
        seconds: that it took.
        timed_out: whether a limit ended it.
    """

    failed: str | None
    seconds: float
    timed_out: bool = False


class Copy:
    """A clone of the commit that a checkout had when the run began.

    Args:
        checkout: whose environment and compiled kernels are used.
        folder: for the clone and the caches; those that are there are used as they are.
    """

    def __init__(self, checkout: Path, folder: Path) -> None:
        self.root = folder / 'copy'
        self._caches = folder / 'numba'
        self._checkout = checkout
        ready = self._caches / 'ready'
        if not ready.exists():
            for part in (self.root, self._caches):
                shutil.rmtree(part, ignore_errors=True)
            _git(checkout, 'clone', '--quiet', '--shared', str(checkout), str(self.root))
            self._share_cache()
            ready.touch()
        _git(self.root, 'checkout', '--quiet', '--force', '.')  # a killed run leaves its fault

    def other_commit(self) -> str:
        """Return a sentence if the copy is of another commit than the checkout has, else ''."""
        commits = [
            _git(root, 'rev-parse', '--short', 'HEAD') for root in (self.root, self._checkout)
        ]
        if commits[0] == commits[1]:
            return ''
        return (
            f'{self.root.parent} has begun with commit {commits[0]}, and the checkout is at '
            f'{commits[1]}: check that out to go on, or give another --folder'
        )

    def _share_cache(self) -> None:
        """Give the sources the times of the checkout's, and its kernels to their folders' names."""
        cache = Path(os.environ['NUMBA_CACHE_DIR'])
        sound = self._caches / 'sound'
        sound.mkdir(parents=True)
        for room in ROOMS:
            for path in (self._checkout / room).rglob('*.py'):
                relative = path.relative_to(self._checkout)
                copied = self.root / relative
                if copied.is_file() and copied.read_bytes() == path.read_bytes():
                    shutil.copystat(path, copied)
        for room in ROOMS:
            for path in [self._checkout / room, *(self._checkout / room).rglob('*')]:
                if path.is_dir():
                    place = path.relative_to(self._checkout)
                    compiled = cache / cache_name(self._checkout, place)
                    if compiled.is_dir():
                        shutil.copytree(compiled, sound / cache_name(self.root, place))

    def cache(self, number: int, fault: Fault) -> Path:
        """Return the cache of a fault, made if it is not there."""
        folder = self._caches / str(number)
        if not folder.is_dir():
            shutil.copytree(self._caches / 'sound', folder, copy_function=os.link)
            if fault.kernel:
                self._drop_affected(folder, number, fault)
        return folder

    def _drop_affected(self, folder: Path, number: int, fault: Fault) -> None:
        """Remove the kernels that a fault changes, and let Numba take the others of its file."""
        sources = {
            str(path.relative_to(self.root)): text
            for room in ROOMS
            for path in (self.root / room).rglob('*.py')
            if 'node_common.kernels import' in (text := path.read_text())
        }
        stamp = float(_SCRATCH_TIME + number), len(fault.plant(sources[fault.path]).encode())
        for file, names in affected_functions(sources, fault.function).items():
            place = Path(file)
            compiled = folder / cache_name(self.root, place.parent)
            for index in compiled.glob(f'{place.stem}.*.nbi'):
                name = index.name.removeprefix(f'{place.stem}.').partition('-')[0]
                if name in names:
                    index.unlink()
                elif file == fault.path:
                    _put_stamp(index, stamp)

    def run(
        self, tests: list[str], tier: str, number: int, fault: Fault | None, *options: str
    ) -> Outcome:
        """Run tests until the first fails, with a fault or without one.

        Args:
            tests: files or names of tests.
            tier: of them.
            number: of the fault.
            fault: to plant while they run; None: the sound copy.
            options: more arguments of pytest.
        """
        if fault is None:
            return self._pytest(tests, tier, self._caches / 'sound', options)
        path = self.root / fault.path
        cache, source, stat = self.cache(number, fault), path.read_bytes(), path.stat()
        path.write_text(fault.plant(source.decode()))
        os.utime(path, (_SCRATCH_TIME + number,) * 2)
        try:
            return self._pytest(tests, tier, cache, options)
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    def _pytest(
        self, tests: list[str], tier: str, cache: Path, options: tuple[str, ...]
    ) -> Outcome:
        python_path = os.environ['PYTHONPATH'].split(os.pathsep)
        environment = os.environ | {
            'NUMBA_CACHE_DIR': str(cache),
            'PYTHONPATH': os.pathsep.join([str(self.root), *python_path[1:]]),
        }
        plugins = ('-p', 'bench.faults.pytest_limits', '-p', 'no:cacheprovider')
        command = [sys.executable, '-m', 'pytest', '-x', '-v', '--tb=no', '-rfE', *plugins]
        command += [f'--tier={tier}', f'--basetemp={self._caches / "tests"}', *options, *tests]
        start, log = time.monotonic(), self._caches / 'output'
        with log.open('wb') as output:
            process = subprocess.Popen(
                command,
                cwd=self.root,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                status = process.wait(MAX_WALL_S)
            except subprocess.TimeoutExpired:
                status = -signal.SIGKILL
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
        return read_outcome(log.read_text(errors='replace'), status, time.monotonic() - start)


MAX_WALL_S = 1800.0
"""[s] for one run of tests."""


def read_outcome(output: str, status: int, seconds: float) -> Outcome:
    """Return the outcome of a run, from the output of pytest with `-v -rfE` and its exit status."""
    found = re.search(r'^(?:FAILED|ERROR) (test/.+?)(?: - |$)', output, re.M)
    if found:
        return Outcome(found.group(1), seconds)
    started = re.findall(r'^(test/\S+::.+?)(?: (?:PASSED|SKIPPED).*)?$', output, re.M)
    if status < 0 or 'Timeout' in output:
        test = started[-1].strip() if started else 'collection'
        return Outcome(test, seconds, timed_out=True)
    return Outcome(None if status in (0, 5) else f'pytest left with {status}', seconds)


def _put_stamp(index: Path, stamp: tuple[float, int]) -> None:
    """Write the time and size of a source into an index of Numba's: its lines are where they were.

    As `IndexDataCacheFile` of `numba.core.caching` writes it.
    """
    with index.open('rb') as file:
        version, (_, overloads) = pickle.load(file), pickle.loads(file.read())
    index.unlink()  # a link to the sound one
    index.write_bytes(pickle.dumps(version) + pickle.dumps((stamp, overloads)))


def cache_name(root: Path, place: Path) -> str:
    """Return the folder that Numba gives the kernels of a source folder, as the package names it.

    As `_CacheLocator.get_suitable_cache_subpath` of `numba.core.caching` computes it.
    """
    folder = root / 'cutting_trainer' / place
    return f'{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}'


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(['git', *words], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()
