"""What whole runs of tests are made of: small phases, and a fit of the first stage alone in a process of its own, which
a test may interrupt."""

import os
import sys
from pathlib import Path

REPO = Path(__file__).parents[2]

# all phases but the last, on images of 64 pixels
SMALL_PHASES = """\
  single_state:
    steps: 150
    initial_gaussians: 1500
    levels: [32, 64]
    level_starts: [0.0, 0.3]
    callbacks: {densify: {budget: 2000, every: 20}}
  discovery: {evidence_size: 64, candidates: 1, search: {surfels: 4000, samples: 200},
    coarse: {steps: 10, levels: [64], level_starts: [0.0]}}
  canonical_fusion: {steps: 12, levels: [64], level_starts: [0.0], canonical: {match_size: 300}}
  articulation: {steps: 12, levels: [64], level_starts: [0.0], refresh: 4}
"""


def command(config: Path, run: Path, threads: int) -> list[str]:
    fit = [sys.executable, "-m", "p2gs", "fit", "-c", str(config), "--run", str(run)]
    return [*fit, "--only", "single_state", "--threads", str(threads)]


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(REPO)}
