"""Where the runs of a bench are carried out: processes of this machine, SLURM jobs (submitit) or a Ray cluster. One key
chooses."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Callable, Protocol

from p2gs.bench.cell import Outcome, stop_all
from p2gs.bench.options import BenchOptions
from p2gs.bench.plan import Cell

Work = Callable[[Cell], Outcome]


class Job(Protocol):
    """A run that was handed over."""

    def done(self) -> bool: ...

    def result(self) -> Outcome:
        """What became of it; raises where the machinery itself failed (a lost node, a job cancelled by hand)."""
        ...


class Executor(Protocol):
    """slots: runs at once, for the time left.  ``start`` returns at once."""

    slots: int

    def start(self, cell: Cell) -> Job: ...

    def close(self, stop: bool) -> None:
        """Wait for nothing more. stop: end what runs now (on a cluster: cancel)."""


class LocalExecutor:
    """``processes`` runs at once on this machine, its cores divided among them."""

    def __init__(self, options: BenchOptions, work: Work):
        self.slots, self.work = options.processes, work
        self.threads = options.threads or max(cores() // options.processes, 1)
        self.pool = ThreadPoolExecutor(self.slots, thread_name_prefix="bench")

    def start(self, cell: Cell) -> Future:
        return self.pool.submit(self.work, replace(cell, threads=self.threads))

    def close(self, stop: bool) -> None:
        if stop:
            self.pool.shutdown(wait=False, cancel_futures=True)
            stop_all()
        self.pool.shutdown(wait=True)


def cores() -> int:
    """CPU cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def executor(options: BenchOptions, work: Work) -> Executor:
    """The executor that the options name. work: carries out one run. Raises UserError where its library is not
    installed."""
    if options.executor == "slurm":
        from p2gs.bench.slurm import SlurmExecutor

        return SlurmExecutor(options, work)
    if options.executor == "ray":
        from p2gs.bench.ray_cluster import RayExecutor

        return RayExecutor(options, work)
    return LocalExecutor(options, work)
