"""Runs a job of ``sfm`` in a child process and gives its result back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from p2gs.types import UserError

NO_PYCOLMAP = 3  # exit code of the child
HOW_TO_INSTALL = (
    "structure from motion needs pycolmap: pip install 'p2gs[capture]' "
    "(there is no wheel for Linux on ARM: bring poses with --poses)"
)


def threads() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_job(task: str, job: dict, folder: Path, progress: Callable[[str], None] = lambda text: None) -> dict:
    """The result of one task. folder: where the job, its result and its log are kept.

    Raises UserError where pycolmap is missing or the child failed, with the last line that it left.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{task}.{name}" for name in ("job", "result", "log")}
    paths["result"].unlink(missing_ok=True)
    job = {"threads": threads(), "seed": 0, **job, "task": task, "result": str(paths["result"])}
    paths["job"].write_text(json.dumps(job))
    command = [sys.executable, "-m", "p2gs.data.capture.sfm", str(paths["job"])]
    with (
        open(paths["log"], "w") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True) as child,
    ):
        try:
            assert child.stdout is not None  # a pipe
            for line in child.stdout:
                progress(line.strip())
        except KeyboardInterrupt:
            child.terminate()
            raise
        code = child.wait()
    if code == NO_PYCOLMAP:
        raise UserError(HOW_TO_INSTALL)
    if code != 0 or not paths["result"].is_file():
        lines = [line for line in paths["log"].read_text(errors="replace").splitlines() if line.strip()]
        last = lines[-1] if lines else "it said nothing"
        raise UserError(f"structure from motion ended with exit code {code}: {last} (all of it: {paths['log']})")
    return json.loads(paths["result"].read_text())
