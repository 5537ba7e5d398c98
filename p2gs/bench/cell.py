"""One run of a bench: ``p2gs fit``, ``export``, ``test`` as processes of their own, and what became of them.

RUN/cell.json holds {key, status: running|stopped|done|failed, seconds, error, object, setting, seed, parts, words,
host}, RUN/bench.log what the commands said. A run is done when it has a metrics.json that was not made from another
config.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Iterator, Optional, Sequence

from p2gs.bench.plan import Cell

PROGRAM = (sys.executable, "-m", "p2gs")
# stages whose files beside the checkpoint are the run's own: never taken over from another setting's run
OWN = ("finish",)


_children: set[subprocess.Popen] = set()
_stopping = threading.Event()


class Stopped(Exception):
    """The bench is being stopped: the run goes on from its checkpoint next time."""


@dataclass(frozen=True)
class Outcome:
    """status: done or failed.  seconds: this sitting.  error: one sentence where it failed.  lost: not the run failed
    but what carried it out."""

    status: str
    seconds: float
    error: Optional[str] = None
    lost: bool = False


def read_record(run: Path | str) -> dict:
    """RUN/cell.json, {} where there is none (yet)."""
    try:
        return json.loads((Path(run) / "cell.json").read_text())
    except (OSError, ValueError):
        return {}


def is_done(cell: Cell) -> bool:
    """Whether the run has its scores, from this very config."""
    return (Path(cell.run) / "metrics.json").is_file() and read_record(cell.run).get("key", cell.key) == cell.key


def status(cell: Cell) -> str:
    """todo, running, stopped, done or failed, as far as the run folder tells."""
    if is_done(cell):
        return "done"
    record = read_record(cell.run)
    if record.get("key") != cell.key:
        return "todo"
    told = record.get("status", "todo")
    return "todo" if told == "done" else told  # its scores were deleted: to be run again


def run_cell(cell: Cell, program: Sequence[str] = PROGRAM) -> Outcome:
    """Carry out one run, or find that it is done. Never raises for a run that fails: its error is recorded.

    program: the words before ``fit RUN ...``. A second process that is given the same run waits for the first.
    """
    run = Path(cell.run)
    run.mkdir(parents=True, exist_ok=True)
    with locked(run) as lock:
        if is_done(cell):
            # who carried it out may have been lost before, or told to be lost after, it noted that
            if (record := read_record(run)).get("status") != "done":
                note(cell, status="done", seconds=record.get("seconds", 0.0), error=None)
            return Outcome("done", 0.0)
        (run / "metrics.json").unlink(missing_ok=True)
        note(cell, status="running", seconds=0.0, error=None)
        if not (run / "checkpoints").exists():
            take_over(cell)
        began = time.monotonic()
        error = None
        with open(run / "bench.log", "ab") as log:
            try:
                for words in commands(cell):
                    error = execute(program, words, cell, log, lock, began)
                    if error is not None:
                        break
            except BaseException:
                note(cell, status="stopped", seconds=round(time.monotonic() - began, 2), error=None)
                raise
        if error is None and not (run / "metrics.json").is_file():
            error = "p2gs test ended without metrics.json"
        outcome = Outcome("done" if error is None else "failed", round(time.monotonic() - began, 2), error)
        note(cell, status=outcome.status, seconds=outcome.seconds, error=error)
        return outcome


def commands(cell: Cell) -> Iterator[list[str]]:
    """The commands of a run, each asked for when its time has come."""
    threads = [] if cell.threads is None else ["--threads", str(cell.threads)]
    yield ["fit", *cell.words, "--run", cell.run, *threads]
    made = (Path(cell.run) / "meshes" / "end" / "whole.ply").is_file()
    if cell.export and not (made and cell.export == ("ply",)):
        yield ["export", cell.run, "--format", *cell.export]
    yield ["test", cell.run]


def stop_all() -> None:
    """End the processes of all runs of this process; their ``run_cell`` raises Stopped."""
    _stopping.set()
    for child in list(_children):
        child.terminate()


def execute(program: Sequence[str], words: list[str], cell: Cell, log, lock: int, began: float) -> Optional[str]:
    """Run one command with its output in the log; None, or why it failed in one sentence. Raises Stopped after
    ``stop_all``."""
    log.write(f"$ p2gs {shlex.join(words)}\n".encode())
    log.flush()
    at = log.tell()
    environment = dict(os.environ, PYTHONUNBUFFERED="1")
    if cell.threads is not None:
        environment["OMP_NUM_THREADS"] = str(cell.threads)
    # the lock is inherited: a process that outlives a killed bench keeps others out of its run folder
    command = [*program, *words]
    child = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=environment, pass_fds=(lock,)
    )
    left = None if cell.timeout_minutes is None else max(cell.timeout_minutes * 60 - (time.monotonic() - began), 0.01)
    _children.add(child)
    try:
        if _stopping.is_set():
            child.terminate()
        code = child.wait(left)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
        return f"took longer than {cell.timeout_minutes:g} minutes"
    except BaseException:
        child.terminate()
        child.wait()
        raise
    finally:
        _children.discard(child)
    if _stopping.is_set() and code != 0:
        raise Stopped
    return None if code == 0 else why(code, Path(log.name), at)


def why(code: int, log: Path, start: int) -> str:
    """The last ``error: ...`` line of the log from ``start`` on, else its last line, else the exit code or signal."""
    with open(log, "rb") as file:
        file.seek(start)
        lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    told = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    if told:
        return told[-1]
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"{lines[-1]} ({how})" if lines else how


def take_over(cell: Cell) -> None:
    """Copy finished stages of earlier settings; fit itself checks that their config is the one it would use."""
    own = Path(cell.run)
    for donor in map(Path, reversed(cell.donors)):
        found = [p for p in sorted((donor / "checkpoints").glob("*.pt")) if p.stem not in OWN]
        if not is_finished(donor) or not found:
            continue
        (own / "checkpoints").mkdir(parents=True, exist_ok=True)
        for path in found:
            shutil.copyfile(path, own / "checkpoints" / path.name)
        if (donor / "logs" / "stages.json").is_file():  # so that the run's time counts the stages it took over
            (own / "logs").mkdir(exist_ok=True)
            shutil.copyfile(donor / "logs" / "stages.json", own / "logs" / "stages.json")
        return


def is_finished(run: Path) -> bool:
    return read_record(run).get("status") == "done"


def note(cell: Cell, **values) -> None:
    """Write RUN/cell.json."""
    kept = {
        k: v for k, v in dataclasses.asdict(cell).items() if k in ("key", "object", "setting", "seed", "parts", "words")
    }
    path = Path(cell.run) / "cell.json"
    part = path.with_suffix(".part")
    part.write_text(json.dumps({**kept, "host": socket.gethostname(), "time": time.time(), **values}, indent=1) + "\n")
    part.replace(path)


@contextmanager
def locked(run: Path) -> Iterator[int]:
    """Hold RUN/.lock, waiting where another process has it. Yields its file descriptor."""
    import fcntl

    with open(run / ".lock", "w") as file:
        os.set_inheritable(file.fileno(), True)
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.2)
        yield file.fileno()
