"""Figures of studies: workers side by side, and tables after kills and from others' workers."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow.parquet as pq

from bench.figures.figure import Figure
from bench.trials.study import STUDY, computed_twice, kill
from cutting_trainer.studies.bag_collection import find_bags
from cutting_trainer.studies.cluster import compute, own_cluster
from cutting_trainer.studies.designs import Setting
from cutting_trainer.studies.evaluation import Job, evaluate
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.table import TABLE_FILE

SAMPLES = Path(__file__).parents[2] / 'bags' / 'samples' / 'format_7'
TIMED_ROWS = 10
"""Rows of a bag of 5 s, each with another toughness, for one worker and for two."""
REFERENCE_ROWS = 6
"""Of these, rows computed in this process, too."""
TOUGHNESSES = (20, 80)
ROWS = 2 * (1 + len(TOUGHNESSES))
KILLED_WORKERS = 2
_TIMEOUT_S = 120.0
_COMMAND = (sys.executable, '-m')


def measure() -> list[Figure]:
    """Return the figures of lines 1 and 2."""
    with tempfile.TemporaryDirectory() as temporary:
        return [*_scaling(), *_tables(Path(temporary))]


def _scaling() -> list[Figure]:
    (bag,) = find_bags(['palpation'], SAMPLES)
    here = identity_of_worker()
    jobs = [
        Job(bag.place, bag.hash, Setting(i, {'tissue.material.toughness': 20.0 + i}), here)
        for i in range(1, TIMED_ROWS + 1)
    ]
    evaluate(jobs[0])  # this process is warm now
    reference = sum(evaluate(job).cpu for job in jobs[:REFERENCE_ROWS])
    seconds, cpu = dict[int, float](), dict[int, float]()
    with own_cluster(2) as client:
        client.run(evaluate, jobs[0])
        for workers in (2, 1):
            client.cluster.scale(workers)
            while len(client.nthreads()) > workers:
                time.sleep(0.05)
            began = time.monotonic()
            results = {job.setting.number: result for job, result in compute(client, jobs)}
            seconds[workers] = time.monotonic() - began
            cpu[workers] = sum(results[i].cpu for i in range(1, REFERENCE_ROWS + 1))
    return [
        Figure(1, 'rate of two workers, as a share of twice that of one',
               seconds[1] / (2.0 * seconds[2]), 0.85, 'at least', '', TIMED_ROWS,
               'twice the rate of one worker',
               f'{TIMED_ROWS / seconds[2]:.3g} rows in a second by two workers'),
        Figure(1, 'processor time of a row beside another worker', cpu[2] / reference, 1.1,
               'at most', '', REFERENCE_ROWS, 'the same rows in one warm process',
               f'{cpu[2] / REFERENCE_ROWS:.3g} s for each row'),
    ]  # fmt: skip


def _tables(folder: Path) -> list[Figure]:
    study = folder / 'study.yaml'
    values = json.dumps({'tissue.material.toughness': list(TOUGHNESSES)})
    study.write_text(
        f'bags: [{SAMPLES}/palpation, {SAMPLES}/straight_cut]\nsettings: {{grid: {values}}}\n'
    )
    killed, others = folder / 'killed', folder / 'others'
    with _scheduler(folder) as address:  # it starts while others are killed
        kill(study, killed, KILLED_WORKERS, 1)
        commands = [[*STUDY, str(study), '-o', str(to), '--scheduler', address]
                    for to in (others, killed)]  # fmt: skip
        quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
        for running in [subprocess.Popen(command, **quiet) for command in commands]:
            if status := running.wait(_TIMEOUT_S):
                raise RuntimeError(f'a study ended with status {status}')
    table = pq.read_table(killed / TABLE_FILE)
    same = (killed / TABLE_FILE).read_bytes() == (others / TABLE_FILE).read_bytes()
    computed = sum(not reason for reason in table.column('failure').to_pylist())
    return [
        Figure(1, 'rows after workers and then the study were killed (-9)', computed, ROWS,
               'at least', '', ROWS),
        Figure(1, 'of these, rows computed twice', computed_twice(killed), 0, 'at most', '', ROWS),
        Figure(1, 'tables that differ by a bit after these kills', float(not same), 0, 'at most',
               '', KILLED_WORKERS + 1),
        Figure(2, 'tables of a scheduler and two workers of others that differ by a bit',
               float(not same), 0, 'at most', '', 1),
    ]  # fmt: skip


@contextmanager
def _scheduler(folder: Path) -> Iterator[str]:
    """A scheduler and two workers in processes of their own, started as by hand."""
    file = folder / 'scheduler.json'
    dask = (*_COMMAND, 'dask')
    scheduler = ['scheduler', '--host', '127.0.0.1', '--port', '0', '--no-dashboard']
    worker = [
        'worker',
        '--scheduler-file',
        str(file),
        '--nthreads',
        '1',
        '--no-nanny',
        '--no-dashboard',
    ]
    started = [
        subprocess.Popen([*dask, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for words in ([*scheduler, '--scheduler-file', str(file)], worker, worker)
    ]
    try:
        until = time.monotonic() + _TIMEOUT_S
        while not file.exists():
            if time.monotonic() > until:
                raise TimeoutError('no scheduler has started')
            time.sleep(0.05)
        yield json.loads(file.read_text())['address']
    finally:
        for process in started:  # a worker may wait for the scheduler, which has ended before it
            process.kill()
            process.wait()
