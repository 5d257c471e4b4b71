"""Run a study on a SLURM cluster: `python slurm.py study.toml --out /shared/runs/batch`, on a node that may submit jobs.

Needs `pip install 'kros[dask]' dask-jobqueue` in an environment that all nodes see. See README.md for what to set.
"""

import sys

from dask_jobqueue import SLURMCluster

from kros.cli import app

JOBS = 8  # nodes

if __name__ == "__main__":
    with SLURMCluster(
        cores=32,  # of a job
        processes=32,  # as many as cores: every worker has one thread
        memory="64GB",
        walltime="04:00:00",
        # queue="batch", account="project", interface="ib0",
        local_directory="/tmp",
        log_directory="slurm-logs",
    ) as cluster:
        cluster.scale(jobs=JOBS)
        app(["run", *sys.argv[1:], "--scheduler", cluster.scheduler_address])
