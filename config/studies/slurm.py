"""Start the workers of a study as jobs of Slurm, and print the address of their scheduler.

Run `./trainer run python config/studies/slurm.py JOBS` where jobs are submitted, and the study with
`--scheduler ADDRESS` beside it. The jobs end with this program. Edit what your cluster wants.
"""

import signal
import sys
from pathlib import Path

from dask_jobqueue import SLURMCluster

TRAINER = Path(__file__).resolve().parents[2] / 'trainer'

if __name__ == '__main__':
    with SLURMCluster(
        cores=1,  # of a job: one worker, which computes a row at a time
        processes=1,
        memory='1 GiB',
        walltime='04:00:00',
        python=f'{TRAINER} run python',
    ) as cluster:
        cluster.scale(jobs=int(sys.argv[1]))
        print(cluster.scheduler_address, flush=True)
        signal.sigwait({signal.SIGINT, signal.SIGTERM})
