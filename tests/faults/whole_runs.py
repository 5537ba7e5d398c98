"""A small fit in processes of its own that tests may kill, starve and send signals to, and what its folder has to hold
in the end."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

REPO = Path(__file__).parents[2]
OUTPUTS = ("twin.json", "splats/*.ply", "meshes/*/*.ply")
TIMEOUT = 1800.0  # seconds for a whole fit, on a machine that does other things as well

# The smoke preset with states long enough, from faint to solid, that both moving parts are found, and a search of two
# seconds.
SMOKE = """
include: [preset/smoke.yaml]
data: {{format: synthetic, root: {root}, kind: demo, size: 64, train_views: 12, test_views: 2, depth: never}}
phases:
  single_state: {{steps: 300, initial_opacity: 0.1, rates: {{opacity_logits: 0.05}}}}
  discovery:
    evidence_size: 64
    look_steps: 4
    reconsider: false
    seek: 0
    rounds: 1
    survey: []
    search: {{surfels: 1000, samples: 100, searches: 1, candidates: 1}}
    coarse: {{steps: 5, levels: [64]}}
  finish: {{exports: [urdf]}}
callbacks: {{checkpoint: {{every: 7}}, progress: {{plain_seconds: 0.2}}}}
"""

# What users run, on the demo's object: minutes a run.
CPU = """
include: [preset/cpu.yaml]
data: {{format: synthetic, root: {root}, kind: demo, size: 200, train_views: 32, test_views: 2, depth: never}}
"""


@dataclass
class Ended:
    """code: negative for a signal.  said: stdout and stderr."""

    code: int
    said: str


class Fit:
    """One started ``p2gs fit``. Leave it as a context: nothing of it stays behind."""

    def __init__(self, config: Path, run: Path, *words: str, **options):
        command = [sys.executable, "-m", "p2gs", "fit", "-c", str(config), "--run", str(run), "--threads", "2", *words]
        environment = {**os.environ, "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(REPO), "PYTHONUNBUFFERED": "1"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "bufsize": 1}
        self.process = subprocess.Popen(command, env=environment, **pipes, **options)
        self.lines: list[str] = []

    def __enter__(self) -> "Fit":
        return self

    def __exit__(self, *exc) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.stdout.close()
        self.process.wait()

    def next_line(self) -> bool:
        """Wait for a line; False where it has ended without one."""
        line = self.process.stdout.readline()
        self.lines += [line] if line else []
        return bool(line)

    def after(self, count: int, delay: float) -> bool:
        """Wait until it has printed ``count`` lines and ``delay`` seconds more; False where it has ended before."""
        while len(self.lines) < count:
            if not self.next_line():
                return False
        try:
            self.process.wait(delay)
        except subprocess.TimeoutExpired:
            return True
        return False

    def until(self, text: str) -> bool:
        """Wait for a line that holds the text; False where it has ended without one."""
        while not (self.lines and text in self.lines[-1]):
            if not self.next_line():
                return False
        return True

    def ended(self) -> Ended:
        """Wait for its end. The side process, which has our pipe too, has ended then as well."""
        watchdog = threading.Timer(TIMEOUT, self.process.kill)
        watchdog.start()
        while self.next_line():
            pass
        watchdog.cancel()
        return Ended(self.process.wait(), "".join(self.lines))

    def stage(self) -> str:
        """What it was at: the stage that its last line names, ``start`` before the first."""
        words = [line.split()[0].rstrip(":") for line in self.lines if line.strip()]
        return words[-1] if words else "start"

    def children(self) -> list[int]:
        """Process numbers of those it has started."""
        pid = self.process.pid
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
        return [int(word) for word in text.split()]


def fit(config: Path, run: Path, *words: str, **options) -> Ended:
    with Fit(config, run, *words, **options) as one:
        return one.ended()


def outputs(run: Path) -> dict[str, str]:
    """SHA-256 of every file of the result that has to be the same bytes, by its path in the folder."""
    files = sorted(path for pattern in OUTPUTS for path in run.glob(pattern))
    return {str(path.relative_to(run)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@dataclass
class Whole:
    """A fit that nothing has disturbed. lines: printed.  gap: mean seconds between two."""

    config: Path
    run: Path
    outputs: dict[str, str]
    lines: int
    gap: float

    def same(self, run: Path, ended: Optional[Ended] = None) -> None:
        """The folder holds the same bytes."""
        assert ended is None or ended.code == 0, ended.said
        assert outputs(run) == self.outputs, f"{run} differs from the undisturbed run"


def make_whole(folder: Path, text: str = SMOKE) -> Whole:
    config = folder / "fit.yaml"
    config.write_text(text.format(root=folder / "scene"))
    fit(config, folder / "first", "--only", "single_state")  # generates the scene, which would count into the gap
    began = time.monotonic()
    with Fit(config, folder / "whole") as one:
        ended = one.ended()
    assert ended.code == 0, ended.said
    made, lines = outputs(folder / "whole"), ended.said.count("\n")
    assert json.loads((folder / "whole" / "twin.json").read_text())["num_parts"] > 1, "no moving part: too easy"
    assert {"twin.json", "splats/canonical.ply", "meshes/start/whole.ply", "meshes/end/whole.ply"} <= set(made)
    return Whole(config, folder / "whole", made, lines, (time.monotonic() - began) / lines)
