"""A fit of the first stage alone in a process of its own, which a test may interrupt."""

import os
import sys
from pathlib import Path

REPO = Path(__file__).parents[2]


def command(config: Path, run: Path, threads: int) -> list[str]:
    fit = [sys.executable, "-m", "p2gs", "fit", "-c", str(config), "--run", str(run)]
    return [*fit, "--only", "single_state", "--threads", str(threads)]


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(REPO)}
