"""Dask workers of a study: a cluster of its own, or the scheduler of somebody else."""

import contextlib
import gc
import logging
import os
import time
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, Status, as_completed
from distributed.system import MEMORY_LIMIT
from tornado.ioloop import PeriodicCallback

from cutting_trainer.session.errors import SessionError
from cutting_trainer.studies.evaluation import Job, Result, evaluate
from cutting_trainer.studies.identity import Identity, identity_of_worker

MAX_DEATHS = 5
"""Workers that a row may lose, killed or out of memory, before it counts as failed."""
MAX_MEMORY_BYTES = 4 * 10**9
"""Memory of an own worker, above which it is killed; it has its share of the machine's, if less."""
_NEEDED_MEMORY_BYTES = 8 * 10**8
"""Memory of the machine for each own worker: with its kernels one takes 0.5 GB."""
WORKERS_TIMEOUT_S = 60.0
"""Time for the first worker of somebody else's, and for own ones on a machine that does nothing
else: 20 times the 3 s of processor time that the start of a worker takes."""
_LOST_TIMEOUT_S = 60.0
"""Time for a killed worker to be back, after which it is replaced."""
_RESTORING_PERIOD_MS = 2000.0
_POLL_S = 0.05
_LEAVE_CTRL_C = 'import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)'
"""A terminal interrupts all processes of a command, and this one ends its workers in order."""
_MIN_WAITING = 16
_PER_THREAD = 2
"""Rows that wait at the scheduler for each thread of the workers; the rest waits here."""


@contextlib.contextmanager
def own_cluster(workers: int) -> Iterator[Client]:
    """Start workers in processes of their own, one thread each, and connect to them.

    They end with this process, however it ends. There are fewer where the memory is too small.
    """
    whole = int(MEMORY_LIMIT)  # of the container, if that has less than the machine
    workers = max(min(workers, whole // _NEEDED_MEMORY_BYTES), 1)
    with dask.config.set(
        {
            'distributed.scheduler.allowed-failures': MAX_DEATHS,
            'distributed.scheduler.worker-saturation': 1.0,
            # A paused worker would wait for ever: its memory does not fall.
            'distributed.worker.memory.pause': False,
            'distributed.worker.preload': [_LEAVE_CTRL_C],
            'distributed.deploy.lost-worker-timeout': f'{_LOST_TIMEOUT_S:.0f} s',
        }
    ):
        memory = min(MAX_MEMORY_BYTES, whole // workers)
        logging.getLogger('distributed').setLevel(logging.CRITICAL)
        with (
            LocalCluster(
                n_workers=0,  # a worker killed as it starts would end the whole cluster
                threads_per_worker=1,
                memory_limit=memory,
                host='127.0.0.1',
                dashboard_address='127.0.0.1:0',
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster) as client,
        ):
            restoring = PeriodicCallback(lambda: restore_workers(cluster), _RESTORING_PERIOD_MS)
            client.loop.add_callback(restoring.start)
            try:
                cluster.scale(workers)
                wait_for_own(client, workers)
                yield client
            finally:
                client.loop.add_callback(restoring.stop)


def wait_for_own(client: Client, workers: int) -> None:
    """Wait until all workers are ready, or go on with those that are after some time.

    The time is longer by the load of the machine: a worker has its share of a processor.

    Raises:
        SessionError: there is none.
    """
    began, waited, processors = time.monotonic(), 0.0, len(os.sched_getaffinity(0))
    while len(client.nthreads()) < workers:
        share = min(processors / max(os.getloadavg()[0], 1e-3), 1.0)
        if (waited := time.monotonic() - began) > WORKERS_TIMEOUT_S / share:
            break
        time.sleep(_POLL_S)
    if not client.nthreads():
        raise SessionError(
            f'no worker has started in {waited:.0f} s: free memory, or try --workers 1'
        )


def restore_workers(cluster: Any) -> None:
    """Start workers anew that Dask has given up: those killed again before they were ready."""
    ended = (Status.closed, Status.failed)
    for name in [name for name, nanny in cluster.workers.items() if nanny.status in ended]:
        del cluster.workers[name]
    if set(cluster.worker_spec) - set(cluster.workers):
        cluster.scale(len(cluster.worker_spec))


@contextlib.contextmanager
def others_cluster(address: str) -> Iterator[Client]:
    """Connect to a scheduler, wait for a worker, and check the versions of all.

    Raises:
        SessionError: there is none, it has no workers, or one has other versions.
    """
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    refused = ''
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError, RuntimeError, TypeError, ImportError) as error:
        refused = ' '.join(str(error).split())[:150] or type(error).__name__
    if refused:
        # A client closes itself when it is freed, and where that happens while another one starts
        # it waits for ever: it is freed here.
        gc.collect()
        raise SessionError(
            f'--scheduler {address}: no Dask scheduler answers there ({refused}): start one with '
            '`./trainer run dask scheduler`'
        )
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
        except TimeoutError:
            raise SessionError(
                f'--scheduler {address}: it has no workers after {WORKERS_TIMEOUT_S:.0f} s: start '
                f'some with `./trainer run dask worker {address} --nthreads 1`'
            ) from None
        check_versions(client, address)
        yield client


def check_versions(client: Client, address: str) -> None:
    """Refuse a scheduler or worker whose Dask or trainer is another one than here, or that has
    several threads.

    Raises:
        SessionError: the first difference.
    """
    versions: Any = client.get_versions()
    mine = versions['client']['packages']
    others = {'the scheduler': versions['scheduler'], **versions['workers']}
    for name, theirs in others.items():
        for package in ('distributed', 'dask'):
            if theirs['packages'].get(package) != mine[package]:
                raise SessionError(
                    f'--scheduler {address}: {name} has {package} '
                    f'{theirs["packages"].get(package)}, and here is {mine[package]}: install the '
                    'same (requirements-study-lock.txt)'
                )
    for name, threads in client.nthreads().items():
        if threads > 1:  # threads load kernels in an order of chance, and share one Python
            raise SessionError(
                f'--scheduler {address}: worker {name} has {threads} threads: start workers with '
                '--nthreads 1, and more of them'
            )
    here = identity_of_worker()
    for name, found in client.run(identity_of_worker, on_error='return').items():
        if not isinstance(found, Identity):
            raise SessionError(
                f'--scheduler {address}: worker {name} cannot import the trainer ({found}): start '
                f'it with `./trainer run dask worker {address} --nthreads 1`'
            )
        if differences := here.differences(found):
            raise SessionError(
                f'--scheduler {address}: worker {name} has other code: {"; ".join(differences)}: '
                'use the same checkout everywhere'
            )


def compute(client: Client, jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
    """Compute rows on the workers, and yield each when it is done.

    A row whose workers die again and again, or have other code, is lost: a failure that is
    computed again when the study is started the next time.

    Args:
        client: of the workers.
        jobs: rows; only some of them at a time wait at the scheduler.

    Raises:
        SessionError: the scheduler is gone.
    """
    waiting: dict[str, Job] = {}
    left, run = iter(jobs), uuid.uuid4().hex[:8]
    completed = as_completed(raise_errors=False)

    def submit() -> None:
        threads = sum(client.nthreads().values())
        while len(waiting) < max(_MIN_WAITING, _PER_THREAD * threads):
            if (job := next(left, None)) is None:
                return
            key = f'row-{run}-{job.bag_hash}-{job.setting.identity or "recorded"}'
            waiting[key] = job
            completed.add(client.submit(evaluate, job, key=key, pure=False))

    with _scheduler_lives():
        submit()
        for future in completed:
            job = waiting.pop(future.key)
            yield job, _result(future, job)
            future.release()
            submit()


@contextlib.contextmanager
def _scheduler_lives() -> Iterator[None]:
    try:
        yield
    except (OSError, TimeoutError) as error:
        raise SessionError(_GONE) from error


_GONE = 'the scheduler is gone: start it, and the study again; it goes on with what is left'


def _result(future: Any, job: Job) -> Result:
    if future.status == 'finished':
        return future.result()
    if future.status != 'error':
        raise SessionError(_GONE)
    error = future.exception()
    if isinstance(error, KilledWorker):
        reason = f'its worker died {error.allowed_failures + 1} times: killed, or out of memory'
    else:
        reason = f'the worker could not compute it: {type(error).__name__}: {error}'
    return lost(job, ' '.join(reason.split()))


def lost(job: Job, reason: str) -> Result:
    """Return the result of a row that no worker could compute."""
    return Result(
        outputs={},
        failure=reason,
        differs_from_frame=0,
        identity=replace(job.identity, cpu=''),
        cpu=0.0,
        warm_up=0.0,
        memory=0,
        lost=True,
        reference=job.reference.identity,
    )
