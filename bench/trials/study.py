"""A study of twenty bags under ten settings: one worker against two, kills, a queue model.

    ./trainer run python -m bench.trials.study

The bags are emulated hands on a block, 5 to 7 s each. One worker computes the study, then two. Then
two compute it while workers are killed, and at last the study itself, which goes on afterwards.
"""

import argparse
import heapq
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from bench.common.processes import children_of
from bench.trials.identification import MOVED, SAMPLES, block, emulate
from cutting_trainer.studies.bag_collection import find_bags
from cutting_trainer.studies.designs import Setting
from cutting_trainer.studies.evaluation import Job, evaluate
from cutting_trainer.studies.identity import identity_of_worker
from cutting_trainer.studies.journal import JOURNAL_FILE
from cutting_trainer.studies.table import COSTS_FILE, TABLE_FILE

STUDY = (sys.executable, '-m', 'cutting_trainer.cli', 'study')
GRID = {
    'tissue.material.toughness': [4, 6, 8, 10, 12],
    'tissue.material.youngs_modulus': [4000, 7000],
}
MATERIAL = {'youngs_modulus': 5400.0, 'toughness': 6.0}
KILLS = 20


def kill(study: Path, output: Path, kills: int, every: int) -> None:
    """Start a study, kill its workers one after the other, and in the end itself.

    Args:
        study: file.
        output: folder.
        kills: how many workers are killed.
        every: rows between two kills.
    """
    command = [*STUDY, str(study), '-o', str(output), '--workers', '2']
    quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as running:
        for number in range(kills + 1):
            while _lines(output) <= number * every:
                if running.poll() is not None:
                    raise RuntimeError(f'the study ended with status {running.returncode}')
                time.sleep(0.02)
            while number < kills and not (workers := _workers_of(running.pid)):
                time.sleep(0.02)
            victim = workers[0] if number < kills else running.pid
            os.kill(victim, signal.SIGKILL)


def _lines(output: Path) -> int:
    file = output / JOURNAL_FILE
    return file.read_bytes().count(b'\n') if file.exists() else 0


def _workers_of(process: int) -> list[int]:
    """Return the processes that compute for a study."""
    named = {pid: Path(f'/proc/{pid}/cmdline').read_bytes() for pid in children_of(process)}
    return [pid for pid, words in named.items() if b'multiprocessing.spawn' in words]


def computed_twice(output: Path) -> int:
    """Return how many rows of a journal stand there again."""
    rows = (output / JOURNAL_FILE).read_text().splitlines()
    return len(rows) - len({tuple(json.loads(row)['key']) for row in rows})


def queue_time(rows: Iterable[float], workers: int) -> float:
    """Return when the last of some rows is done [s], each taken by the first free worker.

    Args:
        rows: time of each [s], in their order.
        workers: number.
    """
    free = [0.0] * workers
    for row in rows:
        heapq.heappush(free, heapq.heappop(free) + row)
    return max(free)


def _run(study: Path, output: Path, workers: int) -> float:
    """Compute a study and return its time [s]."""
    began = time.monotonic()
    command = [*STUDY, str(study), '-o', str(output), '--workers', str(workers)]
    subprocess.run(command, check=True, capture_output=True, timeout=3600)
    return time.monotonic() - began


def _write(folder: Path, bags: int) -> Path:
    """Write bags and a study of them; return its file."""
    mesh = block(folder / 'block.vtk', 1, None)
    for number in range(bags):
        hand = SAMPLES / ('palpation', 'straight_cut')[number % 2]
        emulate(hand, folder / 'bags' / f'{number:02}', mesh, MATERIAL, (number,), MOVED)
    study = folder / 'study.yaml'
    study.write_text(f'bags: [bags]\nsettings: {{grid: {json.dumps(GRID)}}}\n')
    return study


def _warm_cpu(folder: Path) -> dict[str, float]:
    """Return the processor time of one row of each bag in this process [s], by hash."""
    here, key = identity_of_worker(), 'tissue.material.toughness'
    found = {}
    for bag in find_bags(['bags'], folder):
        jobs = [Job(bag.place, bag.hash, Setting(i, {key: 5.0 + i}), here) for i in range(2)]
        evaluate(jobs[0])
        found[bag.hash] = evaluate(jobs[1]).cpu
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the trial and print its figures as JSON."""
    parser = argparse.ArgumentParser(description='A study of twenty bags under ten settings.')
    parser.add_argument('--bags', type=int, default=20)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        study = _write(folder, options.bags)
        warm = _warm_cpu(folder)
        seconds = {workers: _run(study, folder / f'by_{workers}', workers) for workers in (1, 2)}
        killed = folder / 'killed'
        kill(study, killed, KILLS, 4)
        _run(study, killed, 2)
        tables = [(folder / to / TABLE_FILE).read_bytes() for to in ('by_1', 'by_2', 'killed')]
        table, costs = (
            pq.read_table(folder / 'by_2' / file).to_pydict() for file in (TABLE_FILE, COSTS_FILE)
        )
        alone = pq.read_table(folder / 'by_1' / COSTS_FILE).to_pydict()
        rows = len(table['failure'])
        shares = [
            cpu / warm[bag]
            for bag, number, cpu in zip(
                costs['bag_hash'], costs['setting'], costs['cpu'], strict=True
            )
            if number
        ]
        around = seconds[1] - sum(alone['cpu'])
        predicted = around + queue_time(costs['cpu'], 2)
        print(json.dumps({
            'rows': rows, 'failed': sum(map(bool, table['failure'])), 'seconds': seconds,
            'share_of_linear': seconds[1] / (2.0 * seconds[2]),
            'cpu_over_warm': float(np.median(shares)),
            'queue_model_seconds': predicted,
            'computed_twice_after_kills': computed_twice(killed),
            'same_tables': tables[0] == tables[1] == tables[2],
        }, indent=2))  # fmt: skip
    return 0


if __name__ == '__main__':
    sys.exit(main())
