"""Runs as SLURM jobs, by submitit. The only file that imports it."""

from __future__ import annotations

from dataclasses import replace

from p2gs.bench.cell import Outcome
from p2gs.bench.options import BenchOptions
from p2gs.bench.plan import Cell
from p2gs.types import UserError


class SlurmExecutor:
    """One job a run. The folder of the bench and the environment must be the same on every node.

    Killing the bench leaves the jobs in the queue; starting it again finds what they finished and waits for those that
    still run.
    """

    def __init__(self, options: BenchOptions, work):
        try:
            import submitit
        except ImportError as err:
            raise UserError("executor: slurm needs submitit (pip install 'p2gs[slurm]')") from err
        o = options.slurm
        self.slots = 1 if o.cluster == "debug" else o.jobs
        self.cpus, self.work = options.threads or o.cpus, work
        self.executor = submitit.AutoExecutor(folder=options.folder / "slurm" / "%j", cluster=o.cluster)
        resources = {"timeout_min": o.minutes, "cpus_per_task": o.cpus, "gpus_per_node": o.gpus, "mem_gb": o.memory_gb}
        resources["name"] = options.name
        if o.cluster == "slurm":
            resources["slurm_array_parallelism"] = o.jobs
        try:
            self.executor.update_parameters(**resources, **o.extra)
        except (NameError, ValueError, TypeError) as err:
            raise UserError(f"slurm.extra: submitit does not take these options ({err})") from err
        self.jobs = []

    def start(self, cell: Cell):
        job = SubmittedJob(self.executor.submit(self.work, replace(cell, threads=self.cpus)))
        self.jobs.append(job.job)
        return job

    def close(self, stop: bool) -> None:
        if stop:
            for job in self.jobs:
                if not job.done():
                    job.cancel(check=False)


class SubmittedJob:
    """submitit's job as the bench wants it."""

    def __init__(self, job):
        self.job = job

    def done(self) -> bool:
        return self.job.done()

    def result(self) -> Outcome:
        return self.job.result()
