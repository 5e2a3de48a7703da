"""Studies on workers: the same rows, once each, whatever happens to the workers."""

import gc
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest
from distributed import Client, LocalCluster

from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.exit_status import Status
from cutting_trainer.studies.cluster import (
    check_versions,
    compute,
    others_cluster,
    own_cluster,
    wait_for_own,
)
from cutting_trainer.studies.designs import RECORDED, Setting
from cutting_trainer.studies.evaluation import Job
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.journal import JOURNAL_FILE
from cutting_trainer.studies.study_command import StudyOptions, run_study
from cutting_trainer.studies.table import COSTS_FILE, TABLE_FILE

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / 'bags' / 'samples' / 'format_7'
STUDY = f"""\
bags: [{SAMPLES}/palpation, {SAMPLES}/straight_cut, damaged]
settings:
  cases:
    - tissue.material.toughness: 20
    - tissue.integrator: euler
      tissue.damping.alpha: 0
      tissue.damping.beta: 0
"""
ROWS = 9
_TIMEOUT_S = 300.0


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two bags and a damaged one, and of a setting that contradicts itself."""
    folder = tmp_path_factory.mktemp('study')
    (folder / 'study.yaml').write_text(STUDY)
    damaged = Path(shutil.copytree(SAMPLES / 'palpation', folder / 'damaged'))
    (mcap,) = damaged.glob('*.mcap')
    mcap.write_bytes(mcap.read_bytes()[:5000])
    return folder


@pytest.fixture(scope='module')
def one_worker(folder: Path) -> Path:
    """Results of one worker."""
    output = folder / 'one'
    assert run_study(StudyOptions(folder / 'study.yaml', output, workers=1)) is Status.FAILED
    return output


def lines(output: Path) -> int:
    file = output / JOURNAL_FILE
    return file.read_bytes().count(b'\n') if file.exists() else 0


def wait_for(rows: int, output: Path) -> None:
    until = time.monotonic() + _TIMEOUT_S
    while lines(output) < rows:
        assert time.monotonic() < until, f'{lines(output)} of {rows} rows'
        time.sleep(0.02)


def test_failures_are_rows_with_their_reasons_and_each_bag_is_computed_as_recorded_once(
    one_worker: Path,
) -> None:
    rows = pq.read_table(one_worker / TABLE_FILE).to_pylist()
    assert [(Path(row['bag']).name, row['setting']) for row in rows] == [
        (bag, setting) for bag in ('palpation', 'straight_cut', 'damaged') for setting in range(3)
    ]
    assert [bool(row['failure']) for row in rows] == [False, False, True] * 2 + [True] * 3
    value = r'straight_cut\.yaml:\d+: tissue: integrator euler has no stable step'
    assert re.match(value, rows[5]['failure']), rows[5]['failure']
    assert 'damaged' in rows[6]['failure'] and rows[6]['largest_force'] is None
    recorded, softer = rows[3:5]
    assert recorded['force_rms_difference'] == 0.0 and recorded['tissue.material.toughness'] is None
    assert softer['tissue.material.toughness'] == 20.0
    assert softer['incision_area'] > 0.0 and softer['force_rms_difference'] > 0.0
    costs = pq.read_table(one_worker / COSTS_FILE).to_pylist()
    assert sum(row['warm_up'] > 0.05 for row in costs) == 1  # the worker was warm after one row
    page = (one_worker / 'summary.html').read_text()
    assert 'toughness=20' in page and 'no stable step' in page


SLURM = {
    'sbatch': """#!/bin/sh
        cp "$1" "$0.$$.job"
        setsid sh "$0.$$.job" > "$0.$$.log" 2>&1 &
        echo "Submitted batch job $!"
    """,
    'scancel': """#!/bin/sh
        kill -- "-$1"
    """,
}
"""The commands of Slurm: a job is a group of processes on this machine."""


@pytest.mark.thorough
def test_a_study_on_jobs_of_slurm_makes_the_same_table_to_the_bit(
    folder: Path, one_worker: Path
) -> None:
    commands = folder / 'slurm'
    commands.mkdir()
    for name, text in SLURM.items():
        (commands / name).write_text(text)
        (commands / name).chmod(0o755)
    jobs = subprocess.Popen(
        [ROOT / 'trainer', 'run', 'python', 'config/studies/slurm.py', '2'],
        cwd=ROOT,
        env=os.environ | {'PATH': f'{commands}:{os.environ["PATH"]}'},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert jobs.stdout is not None
        address, output = jobs.stdout.readline().strip(), folder / 'jobs'
        with Client(address) as client:
            client.wait_for_workers(2, timeout=_TIMEOUT_S)
            study = StudyOptions(folder / 'study.yaml', output, scheduler=address)
            assert run_study(study) is Status.FAILED
            assert (output / TABLE_FILE).read_bytes() == (one_worker / TABLE_FILE).read_bytes()
            workers = [int(pid) for pid in client.run(os.getpid).values()]
    finally:
        jobs.send_signal(signal.SIGINT)
        assert jobs.wait(_TIMEOUT_S) == 0
    assert not [pid for pid in workers if Path(f'/proc/{pid}').exists()]


@pytest.mark.thorough
def test_two_workers_of_which_one_is_killed_make_the_same_table_to_the_bit(
    folder: Path, one_worker: Path
) -> None:
    output = folder / 'two'
    command = [sys.executable, '-m', 'cutting_trainer.cli', 'study', str(folder / 'study.yaml')]
    running = subprocess.Popen(
        [*command, '-o', str(output), '--workers', '2'], stdout=subprocess.DEVNULL
    )
    try:
        wait_for(1, output)
        os.kill(min(workers_of(running.pid)), signal.SIGKILL)
        assert running.wait(_TIMEOUT_S) == Status.FAILED
    finally:
        running.kill()
        running.wait()
    assert lines(output) == ROWS
    assert (output / TABLE_FILE).read_bytes() == (one_worker / TABLE_FILE).read_bytes()


def workers_of(process: int) -> list[int]:
    """Processes that Dask's nannies have started."""
    found = []
    for status in Path('/proc').glob('[0-9]*/stat'):
        parent = int(status.read_text().rpartition(')')[2].split()[1])
        words = (status.parent / 'cmdline').read_bytes() if parent == process else b''
        if b'multiprocessing.spawn' in words:
            found.append(int(status.parent.name))
    return found


@pytest.mark.thorough
def test_killed_study_goes_on_and_has_each_row_once(folder: Path, one_worker: Path) -> None:
    output, file = folder / 'killed', folder / 'study.yaml'
    command = [sys.executable, '-m', 'cutting_trainer.cli', 'study', str(file), '-o', str(output)]
    running = subprocess.Popen([*command, '--workers', '1'], stderr=subprocess.DEVNULL)
    try:
        wait_for(2, output)
        workers = workers_of(running.pid)
    finally:
        running.kill()
        running.wait()
    done = lines(output)
    assert done < ROWS
    before = (output / JOURNAL_FILE).read_bytes()
    until = time.monotonic() + _TIMEOUT_S
    while any(Path(f'/proc/{worker}').exists() for worker in workers):  # they end with it
        assert time.monotonic() < until
        time.sleep(0.05)
    run_study(StudyOptions(file, output, workers=1))
    after = (output / JOURNAL_FILE).read_bytes()
    assert after.startswith(before) and after.count(b'\n') == ROWS
    assert (output / TABLE_FILE).read_bytes() == (one_worker / TABLE_FILE).read_bytes()


def test_ctrl_c_ends_a_study_in_order_with_one_sentence(folder: Path) -> None:
    output = folder / 'interrupted'
    command = [sys.executable, '-m', 'cutting_trainer.cli', 'study', str(folder / 'study.yaml')]
    running = subprocess.Popen(
        [*command, '-o', str(output), '--workers', '2'],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_for(1, output)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does
        _, said = running.communicate(timeout=_TIMEOUT_S)
    finally:
        running.kill()
    assert running.returncode == Status.INTERRUPTED and 'goes on with what is left' in said
    assert 'Traceback' not in said
    assert 0 < lines(output) < ROWS


def test_study_goes_on_after_the_last_whole_row_of_its_journal(
    folder: Path, one_worker: Path
) -> None:
    output = folder / 'cut off'
    output.mkdir()
    whole = (one_worker / JOURNAL_FILE).read_bytes().splitlines(keepends=True)
    kept = b''.join(whole[:-1])
    (output / JOURNAL_FILE).write_bytes(kept + whole[-1][:20])
    run_study(StudyOptions(folder / 'study.yaml', output, workers=1))
    after = (output / JOURNAL_FILE).read_bytes()
    assert after.startswith(kept) and after.count(b'\n') == ROWS
    assert (output / TABLE_FILE).read_bytes() == (one_worker / TABLE_FILE).read_bytes()


def test_study_that_is_done_starts_no_workers_and_other_outputs_compute_nothing(
    folder: Path, one_worker: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('cutting_trainer.studies.cluster.LocalCluster', None)
    before = (one_worker / TABLE_FILE).read_bytes()
    for more in ('', 'outputs: [contact]\n'):
        (folder / 'again.yaml').write_text(STUDY + more)
        run_study(StudyOptions(folder / 'again.yaml', one_worker))
    assert 'incision_area' not in pq.read_table(one_worker / TABLE_FILE).column_names
    (one_worker / TABLE_FILE).write_bytes(before)


# Workers in this process: the protocol, without computing.


IN_PROCESS: Any = {'n_workers': 1, 'processes': False, 'dashboard_address': '127.0.0.1:0'}


@pytest.fixture(scope='module')
def client() -> Iterator[Client]:
    with (
        LocalCluster(**IN_PROCESS, threads_per_worker=1) as cluster,
        Client(cluster) as client,
    ):
        yield client


def jobs(count: int) -> list[Job]:
    other = replace(identity_of_worker(), numba='0.1')
    settings = [RECORDED, *(Setting(i, {'tissue.model': str(i)}) for i in range(1, count))]
    return [Job('nowhere', 'none', setting, other) for setting in settings]


def test_worker_with_other_code_computes_nothing_and_its_rows_are_left_for_the_next_time(
    client: Client,
) -> None:
    found = list(compute(client, jobs(40)))
    assert len({job.setting.number for job, _ in found}) == 40
    here = identity_of_worker().numba
    for _, result in found:
        assert result.lost and f'numba is {here} on the worker, and 0.1 here' in result.failure


def test_most_rows_wait_here_and_not_at_the_scheduler(client: Client) -> None:
    given = iter(jobs(1000))
    computed = compute(client, given)
    next(computed)
    assert sum(1 for _ in given) >= 1000 - 20
    computed.close()


def test_scheduler_that_does_not_answer_is_named_and_its_client_is_freed_at_once() -> None:
    # Freed later, by the garbage collector, it could wait for ever for a lock of Dask. `_` keeps
    # the error, and by it the frames in which the client was made.
    gc.collect()
    before = len(clients())
    with (
        pytest.raises(SessionError, match=r'--scheduler nothing://there: no Dask scheduler') as _,
        others_cluster('nothing://there'),
    ):
        pass
    assert len(clients()) == before


def clients() -> list[Client]:
    return [found for found in gc.get_objects() if type(found) is Client]


def test_workers_of_others_are_taken(client: Client) -> None:
    with others_cluster(client.scheduler.address) as another:
        assert another.nthreads() == client.nthreads()


@pytest.mark.parametrize(
    ('dask', 'threads', 'found', 'said'),
    [
        ('1', 1, replace(identity_of_worker(), code='0'), 'other code: code is 0 on the worker'),
        ('1', 1, ModuleNotFoundError('no cutting_trainer'), 'cannot import the trainer.*: start'),
        ('2', 1, identity_of_worker(), 'tcp://w has dask 2, and here is 1: install the same'),
        ('1', 2, identity_of_worker(), 'tcp://w has 2 threads: start workers with --nthreads 1'),
    ],
)
def test_worker_of_others_that_would_compute_otherwise_is_refused(
    dask: str, threads: int, found: object, said: str
) -> None:
    mine, theirs = ({'packages': {'dask': d, 'distributed': '1'}} for d in ('1', dask))
    versions = {'client': mine, 'scheduler': mine, 'workers': {'tcp://w': theirs}}
    world: Any = SimpleNamespace(
        get_versions=lambda: versions,
        nthreads=lambda: {'tcp://w': threads},
        run=lambda function, on_error: {'tcp://w': found},
    )
    with pytest.raises(SessionError, match=said):
        check_versions(world, 'tcp://s')


def test_worker_that_dask_gives_up_is_started_anew() -> None:
    # It does so where a worker is killed again before it is back: such a study had no end.
    with own_cluster(1) as client:
        (before,) = client.nthreads()
        until = time.monotonic() + _TIMEOUT_S
        while not client.cluster.workers:  # it is there before its cluster knows of it
            assert time.monotonic() < until, 'the cluster has no worker'
            time.sleep(0.01)
        (nanny,) = client.cluster.workers.values()
        client.sync(nanny.close)
        while not client.nthreads() or before in client.nthreads():
            assert time.monotonic() < until, 'there is no worker any more'
            time.sleep(0.1)


@pytest.mark.parametrize(('load', 'starts'), [(0.0, False), (40.0 * (os.cpu_count() or 1), True)])
def test_own_workers_have_more_time_to_start_on_a_loaded_machine(
    load: float, starts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('cutting_trainer.studies.cluster.WORKERS_TIMEOUT_S', 0.1)
    monkeypatch.setattr('os.getloadavg', lambda: (load, load, load))
    ready = time.monotonic() + 0.5
    late: Any = SimpleNamespace(nthreads=lambda: {'w': 1} if time.monotonic() > ready else {})
    with nullcontext() if starts else pytest.raises(SessionError, match='no worker has started'):
        wait_for_own(late, 1)


def test_worker_that_takes_too_much_memory_is_ended_and_its_row_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('cutting_trainer.studies.cluster.MAX_MEMORY_BYTES', 150 * 10**6)
    monkeypatch.setattr('cutting_trainer.studies.cluster.MAX_DEATHS', 0)
    job = replace(jobs(1)[0], identity=identity_of_worker())
    with own_cluster(1) as client:
        ((_, result),) = compute(client, [job])
    assert result.lost and result.failure.startswith('its worker died 1 times')
