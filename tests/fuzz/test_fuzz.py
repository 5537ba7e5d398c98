"""Damaged scenes, configs, twins, splats and checkpoints: read, or refused in a sentence; no traceback, no hang, no
more than 2 GB."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

WORKER = Path(__file__).with_name("worker.py")


def fuzz(folder: Path, seed: int, count: int, timeout: float) -> None:
    command = [sys.executable, str(WORKER), str(folder), "--seed", str(seed), "--count", str(count)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, cwd=WORKER.parents[2])
    assert done.returncode == 0, done.stderr[-2000:]
    *faults, totals = map(json.loads, done.stdout.splitlines())
    told = "\n\n".join(
        f"mutant {f['number']} of seed {seed}, {f['target']}, {f['damage']}\n{f['fault']}" for f in faults[:10]
    )
    assert not faults, f"{len(faults)} of {count} mutants:\n{told}"
    assert totals["mutants"] == count and totals["grown_mib"] < 2048, totals


def test_two_hundred_mutants(tmp_path):
    fuzz(tmp_path, seed=0, count=200, timeout=280)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_two_thousand_mutants(tmp_path):
    fuzz(tmp_path, seed=1, count=2000, timeout=3500)
