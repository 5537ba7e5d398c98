"""SIGTERM amid training, and two fits in one folder: what a scheduler and a hurried user do. The rest is in
tests/faults."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from one_stage import REPO, command, environment

from p2gs.run_lock import locked
from p2gs.types import UserError

STATES = """
include: [preset/smoke.yaml]
data: {{format: synthetic, root: {root}, kind: demo, size: 48, train_views: 8, test_views: 1, depth: never}}
phases:
  single_state:
    {{steps: 20000, initial_gaussians: 300, levels: [24], level_starts: [0.0], callbacks: {{densify: null}}}}
callbacks: {{checkpoint: {{every: 5}}}}
"""


def test_sigterm_saves_the_step_and_says_that_the_run_is_not_done(tmp_path):
    config, run = tmp_path / "states.yaml", tmp_path / "run"
    config.write_text(STATES.format(root=tmp_path / "scene"))
    process = subprocess.Popen(
        command(config, run, 1), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment()
    )
    saved = run / "checkpoints" / "single_state_0.ckpt"
    deadline = time.time() + 200
    while not saved.exists() and process.poll() is None and time.time() < deadline:
        time.sleep(0.02)
    with pytest.raises(UserError, match=f"another fit is running in this folder .process {process.pid} "), locked(run):
        pass
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=200)[0]
    assert process.returncode == 143 and "stopped; give the same command again" in said and "Traceback" not in said, (
        said
    )
    state = torch.load(saved, weights_only=True)
    done = state["loops"]["fit_loop"]["epoch_loop.batch_progress"]["total"]
    assert state["global_step"] == done["completed"] > 0  # between two steps
    with locked(run):  # nobody is left in it
        pass


def test_a_lock_goes_with_its_process(tmp_path):
    holder = "from pathlib import Path\nfrom p2gs.run_lock import locked\n"
    holder += f"with locked(Path({str(tmp_path)!r})): print('in', flush=True); input()"
    environment = {**os.environ, "PYTHONPATH": str(REPO)}
    process = subprocess.Popen(
        [sys.executable, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    )
    assert process.stdout.readline() == b"in\n"
    with pytest.raises(UserError, match="another fit is running"), locked(tmp_path):
        pass
    process.kill()
    process.communicate()
    with locked(tmp_path):
        pass


def test_what_a_killed_run_left_is_waited_for(tmp_path, capfd):
    """The lock's owner is gone, a process that it had handed the lock to is not yet."""
    holder = (
        "import subprocess, sys, os\nfrom pathlib import Path\nfrom p2gs.run_lock import held, locked\n"
        f"with locked(Path({str(tmp_path)!r})):\n"
        "    subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(3)'], pass_fds=held())\n    os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", holder], check=True, env={**os.environ, "PYTHONPATH": str(REPO)})
    with locked(tmp_path):
        pass
    assert "waiting for what is left of process" in capfd.readouterr().err
