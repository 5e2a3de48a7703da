"""Start the workers of a study as jobs of Slurm, and print the address of their scheduler.

Run `./trainer run python config/studies/slurm.py JOBS` where jobs are submitted, and the study with
`--scheduler ADDRESS` beside it. The jobs end with this program. Edit what your cluster wants.
"""

import argparse
import shlex
import shutil
import signal
import threading
from pathlib import Path

from dask_jobqueue import SLURMCluster

TRAINER = Path(__file__).resolve().parents[2] / 'trainer'


def main() -> None:
    """Submit the jobs, and cancel them on Ctrl-C."""
    parser = argparse.ArgumentParser(description='Start workers of a study as jobs of Slurm.')
    parser.add_argument('jobs', type=int, help='how many, one worker each')
    jobs = parser.parse_args().jobs
    if jobs < 1:
        parser.error(f'jobs is {jobs}: give 1 or more')
    if shutil.which('sbatch') is None:
        parser.error('sbatch is not on the PATH: run this where jobs of Slurm are submitted')
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: ended.set())
    with SLURMCluster(
        cores=1,  # of a job: one worker, which computes a row at a time
        processes=1,
        memory='1 GiB',
        walltime='04:00:00',
        python=f'{shlex.quote(str(TRAINER))} run python',
    ) as cluster:
        cluster.scale(jobs=jobs)
        print(cluster.scheduler_address, flush=True)
        ended.wait()


if __name__ == '__main__':
    main()
