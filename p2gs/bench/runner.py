"""Runs a bench: hands over what is not done, notes what failed, shows where it stands."""

from __future__ import annotations

import functools
import json
import signal
import threading
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Iterator, Optional, Sequence

from p2gs.bench.cell import PROGRAM, Outcome, is_done, note, run_cell, status
from p2gs.bench.executors import executor
from p2gs.bench.live import Display
from p2gs.bench.plan import Bench, Cell
from p2gs.config.files import to_yaml
from p2gs.provenance import provenance

POLL = 0.2  # seconds between two looks at the jobs
LOST_AGAIN = 2  # times that a run whose job was lost is handed over again: more is no accident of one node


def run_bench(
    bench: Bench, *, skip_failed: bool = False, program: Sequence[str] = PROGRAM, display: Optional[Display] = None
) -> Counter:
    """Carry out every run that is not done. Returns how many there are by status (done, failed).

    skip_failed: leave runs alone that failed before; otherwise they are tried again.  program: the words before ``fit
    ...``.
    """
    folder = bench.options.folder
    folder.mkdir(parents=True, exist_ok=True)
    save_bench(bench)
    known = {cell.name: status(cell) for cell in bench.cells}
    left_out = ("done", "failed") if skip_failed else ("done",)
    waiting = [cell for cell in bench.cells if known[cell.name] not in left_out]
    known |= {cell.name: "todo" for cell in waiting}
    show = display or Display(bench)
    with interruptible():
        jobs: dict[str, tuple[Cell, Any]] = {}
        lost: Counter = Counter()
        place = executor(bench.options, functools.partial(run_cell, program=tuple(program))) if waiting else None
        stop = True
        try:
            with show.on(known, place.slots if place else 1):
                while waiting or jobs:
                    while place and waiting and len(jobs) < place.slots:
                        cell = waiting.pop(0)
                        jobs[cell.name] = cell, place.start(cell)
                        known[cell.name] = "running"
                        show.started(cell)
                    for name, (cell, job) in list(jobs.items()):
                        if job.done():
                            del jobs[name]
                            lost[name] += (outcome := result(cell, job)).lost
                            if outcome.lost and lost[name] <= LOST_AGAIN:
                                waiting.append(cell)
                                known[name] = "todo"
                                show.lost(cell, outcome)
                                continue
                            known[name] = outcome.status
                            show.ended(cell, outcome)
                    show.refresh()
                    time.sleep(POLL if jobs else 0)
            stop = False
        finally:
            if place is not None:
                place.close(stop)
    return Counter(known.values())


def result(cell: Cell, job) -> Outcome:
    """What became of a job. A failure of the machinery (a lost node, a killed worker) is the run's failure, noted in
    its folder, and ``lost``: unlike a run that failed by itself it may well succeed elsewhere."""
    try:
        return job.result()
    except Exception as err:
        text = " ".join(str(err).split()) or type(err).__name__
        Path(cell.run).mkdir(parents=True, exist_ok=True)
        if not is_done(cell):
            note(cell, status="failed", seconds=0.0, error=text[-300:])
        return Outcome("failed", 0.0, text[-300:], lost=True)


def save_bench(bench: Bench) -> None:
    """OUT/bench.yaml, which runs the same bench again, and OUT/cells.json, which ``p2gs table`` reads."""
    folder = bench.options.folder
    (folder / "bench.yaml").write_text(to_yaml({**bench.tree, "out": str(folder)}), encoding="utf-8")
    cells = [
        {"object": c.object, "setting": c.setting, "seed": c.seed, "run": str(Path(c.run).relative_to(folder))}
        for c in bench.cells
    ]
    scenes = [{"name": s.name, "column": s.column, "parts": s.parts} for s in bench.scenes]
    o = bench.options
    about = {
        "p2gs": provenance(),
        "presets": o.presets,
        "name": o.name,
        "tables": o.tables,
        "scenes": scenes,
        "cells": cells,
    }
    (folder / "cells.json").write_text(json.dumps(about, indent=1) + "\n")


@contextmanager
def interruptible() -> Iterator[None]:
    """A termination signal stops the bench as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
