"""One training stage of a run in a process of its own, beside the run.

The two single states need nothing of each other, and two processes of one thread each train them faster than one
process of two threads trains one after the other. ``p2gs.runtime.side_worker`` is what that process runs.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path

import torch

from p2gs.config.run import RunConfig
from p2gs.models.stage import PHASES
from p2gs.run_lock import held
from p2gs.types import UserError

MISTAKE = "error: "  # what a line starts with that tells a user's mistake
PATIENCE = 60.0  # seconds that another program may take: to save its state, to answer


def can_run_beside(cfg: RunConfig, device: torch.device, phase: str = "single_state") -> bool:
    """Whether both states' runs of a phase can be trained at once: with two threads or more, on a device that two
    processes may use, nothing that wants a run for itself.

    A loss or callback that the running program registered itself (no plugin) is unknown to another process: then one
    after the other.
    """
    section = cfg.phases[phase]
    callbacks = section.new_callbacks().values()
    known = {"p2gs", *(name.removesuffix(".py").replace("/", ".") for name in cfg.plugins)}
    makers = [PHASES[phase], *(type(x) for x in (cfg.data, section.config, *section.losses.values(), *callbacks))]
    foreign = any(not any(f"{make.__module__}.".startswith(f"{name}.") for name in known) for make in makers)
    if torch.get_num_threads() < 2 or foreign or any(c.alone for c in callbacks):
        return False
    return device.type == "cpu" or takes_processes(device)


def takes_processes(device: torch.device) -> bool:
    """Whether a CUDA device is in its default mode, in which several processes may use it; clusters set others. False
    where the driver's nvidia-smi cannot say, and with a torch (2.2 to 2.4) that does not know which device it is."""
    uuid = getattr(torch.cuda.get_device_properties(device), "uuid", None)
    if uuid is None:
        return False
    ask = ["nvidia-smi", "-i", f"GPU-{uuid}", "--query-gpu=compute_mode", "--format=csv,noheader"]
    try:
        told = subprocess.run(ask, capture_output=True, text=True, timeout=PATIENCE, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return False
    return told.strip() == "Default"


class SideStage:
    """A stage that runs in another process; its lines come out among ours. Use as a context: leaving it stops what
    still runs."""

    def __init__(self, run_dir: Path, stage: str, threads: int):
        self.stage, self.began, self.seconds = stage, time.perf_counter(), 0.0
        self.last: deque[str] = deque(maxlen=20)
        search = os.pathsep.join(filter(None, sys.path))  # plugins are found there as they are here
        self.process = subprocess.Popen(
            [sys.executable, "-m", "p2gs.runtime.side_worker", str(run_dir), stage, str(threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONPATH": search},
            pass_fds=held(),  # while it saves its state after the run was killed, no other run may write there
            start_new_session=True,  # Ctrl-C reaches it through the pipe alone, so once
        )
        self.reader = threading.Thread(target=self._forward, daemon=True)
        self.reader.start()

    def _forward(self) -> None:
        assert self.process.stdout is not None  # it is a pipe
        for line in self.process.stdout:
            self.last.append(line.rstrip("\n"))
            if not line.startswith(MISTAKE):
                print(line, end="", flush=True)
        self.seconds = time.perf_counter() - self.began

    def __enter__(self) -> "SideStage":
        return self

    def __exit__(self, *exc) -> None:
        assert self.process.stdin is not None  # it is a pipe
        self.process.stdin.close()
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def wait(self) -> float:
        """Until the stage is done; returns its seconds. Raises UserError for a user's mistake and when the process was
        lost."""
        self.process.wait()
        self.reader.join()
        code = self.process.returncode
        if code:
            mistakes = [line.removeprefix(MISTAKE) for line in self.last if line.startswith(MISTAKE)]
            if mistakes:
                raise UserError(mistakes[-1])
            raise UserError(
                f"{self.stage}: its process ended with code {code}{_reason(code)}; what it said last stands above, "
                "and the same command goes on where it stopped"
            )
        return self.seconds


def _reason(code: int) -> str:
    if code == -signal.SIGKILL:
        return " (it was killed, which is what happens when memory runs out)"
    return f" ({signal.Signals(-code).name})" if code < 0 else ""
