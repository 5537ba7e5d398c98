"""Runs as tasks of a Ray cluster. The only file that imports ray."""

from __future__ import annotations

import logging
from dataclasses import replace

from p2gs.bench.cell import Outcome
from p2gs.bench.options import BenchOptions
from p2gs.bench.plan import Cell
from p2gs.types import UserError


class RayExecutor:
    """One task a run, as many at once as the cluster has room for. The folder of the bench must be the same on every
    node."""

    def __init__(self, options: BenchOptions, work):
        try:
            import ray
        except ImportError as err:
            raise UserError("executor: ray needs Ray (pip install 'p2gs[ray]')") from err
        self.ray, o = ray, options.ray
        self.started = not ray.is_initialized()
        if self.started:
            try:
                ray.init(
                    address=o.address,
                    include_dashboard=False,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    configure_logging=False,
                )
            except Exception as err:
                raise UserError(
                    f"ray.address: no cluster at {o.address!r} ({' '.join(str(err).split())[:200]})"
                ) from err
        have = ray.cluster_resources()
        for name, need in (("CPU", o.cpus), ("GPU", o.gpus)):
            if need > have.get(name, 0):
                raise UserError(f"ray.{name.lower()}s: a run asks for {need:g}, the cluster has {have.get(name, 0):g}")
        rooms = [have[name] // need for name, need in (("CPU", o.cpus), ("GPU", o.gpus)) if need > 0]
        self.slots = max(int(min(rooms, default=1)), 1)
        self.threads = options.threads or max(int(o.cpus), 1)
        self.work = work
        self.task = ray.remote(num_cpus=o.cpus, num_gpus=o.gpus, max_retries=0)(carry_out)
        self.jobs: list[RayJob] = []

    def start(self, cell: Cell):
        self.jobs.append(RayJob(self.ray, self.task.remote(self.work, replace(cell, threads=self.threads))))
        return self.jobs[-1]

    def close(self, stop: bool) -> None:
        if stop:
            for job in self.jobs:
                if not job.done():
                    self.ray.cancel(job.reference, force=True)
        if self.started:
            self.ray.shutdown()


def carry_out(work, cell: Cell) -> Outcome:
    """The task."""
    return work(cell)


class RayJob:
    """A task as the bench wants it."""

    def __init__(self, ray, reference):
        self.ray, self.reference = ray, reference

    def done(self) -> bool:
        return bool(self.ray.wait([self.reference], timeout=0)[0])

    def result(self) -> Outcome:
        return self.ray.get(self.reference)
