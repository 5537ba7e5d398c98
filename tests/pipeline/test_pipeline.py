"""The whole way on a small generated scene: result folder, resume after kill -9, components switched off."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from one_stage import REPO, SMALL_PHASES

from p2gs.gaussians import handover

SMALL = """
include: [{repo}/configs/preset/smoke.yaml]
data: {{format: synthetic, root: {root}, kind: demo, size: 64, train_views: 12, test_views: 2, depth: never}}
num_parts: 3
phases:
{phases}  finish: {{polish: {{steps: 8, levels: [64], level_starts: [0.0]}}}}
callbacks:
  checkpoint: {{every: 4}}
"""


def fit(folder: Path, *words: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        command(folder, *words), capture_output=True, text=True, timeout=300, env=environment(), **options
    )


def command(folder: Path, *words: str) -> list[str]:
    return [sys.executable, "-m", "p2gs", "fit", "-c", str(folder / "small.yaml"), "--threads", "2", *words]


def environment() -> dict:
    return {**os.environ, "OMP_WAIT_POLICY": "passive", "PYTHONPATH": str(REPO)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("pipeline")
    (path / "small.yaml").write_text(SMALL.format(repo=REPO, phases=SMALL_PHASES, root=path / "scene"))
    done = fit(path, "--run", str(path / "whole"))
    assert done.returncode == 0, done.stderr
    return path


def test_result_folder(folder):
    run = folder / "whole"
    twin = json.loads((run / "twin.json").read_text())
    assert twin["format"] == "p2gs-twin/1" and twin["parts"][0] == {"id": 0, "kind": "static"} | twin["parts"][0]
    assert twin["num_parts"] == len(twin["parts"])
    for part in twin["parts"][1:]:
        joint = part["joint"]
        assert joint["type"] in ("revolute", "prismatic") and len(joint["axis"]) == 3
        assert abs(sum(a * a for a in joint["axis"]) - 1) < 1e-6
        assert joint["limits"][0] <= joint["limits"][1] and 0 <= part["confidence"] <= 1
    for name in (
        "config.yaml",
        "splats/canonical.ply",
        "splats/start.ply",
        "splats/end.ply",
        "logs/stages.json",
        "diagnostics.html",
    ):
        assert (run / name).exists(), name
    assert list((run / "media").glob("*.png")) and list((run / "logs").rglob("events*"))


def test_a_finished_run_is_not_run_again(folder):
    before = (folder / "whole" / "twin.json").read_bytes()
    again = fit(folder, "--run", str(folder / "whole"))
    assert again.returncode == 0 and again.stdout.count("done before") == 9, again.stdout + again.stderr
    assert (folder / "whole" / "twin.json").read_bytes() == before


@pytest.mark.parametrize("stage", ["single_state_0", "single_state_1", "canonical_fusion", "articulation"])
def test_kill_and_go_on_gives_the_same_twin(folder, stage, tmp_path):
    """Killed as soon as the stage has a checkpoint of its own, then started again."""
    run = tmp_path / "run"
    process = subprocess.Popen(
        command(folder, "--run", str(run)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment()
    )
    checkpoint = run / "checkpoints" / f"{stage}.ckpt"
    deadline = time.time() + 200
    while not checkpoint.exists() and process.poll() is None and time.time() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoint.exists() or (run / "checkpoints" / f"{stage}.pt").exists()
    done = fit(folder, "--run", str(run))
    assert done.returncode == 0, done.stderr
    for name in ("single_state_0", "single_state_1", "articulation"):
        (a, _), (b, _) = (handover.load(f / "checkpoints" / f"{name}.pt") for f in (folder / "whole", run))
        assert torch.equal(a.gaussians.means, b.gaussians.means), name
    assert (run / "twin.json").read_bytes() == (folder / "whole" / "twin.json").read_bytes()
    assert (run / "splats/canonical.ply").read_bytes() == (folder / "whole" / "splats/canonical.ply").read_bytes()
    assert json.loads((run / "diagnostics.json").read_text()) == json.loads(
        (folder / "whole" / "diagnostics.json").read_text()
    )


def test_everything_that_can_be_null(folder, tmp_path):
    """One run with each loss but one and every callback off."""
    words = [f"--callbacks.{n}=null" for n in ("progress", "checkpoint", "scalars", "images", "previews", "evaluation")]
    words += [
        "--phases.single_state.callbacks.densify=null",
        "--phases.single_state.losses.alpha=null",
        "--phases.single_state.losses.depth_variance=null",
    ]
    words += [
        f"--phases.articulation.losses.{n}=null"
        for n in ("alpha", "depth_variance", "surface_depth", "part", "art", "contact", "velocity", "vector")
    ]
    done = fit(folder, "--run", str(tmp_path / "bare"), *words)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "bare" / "twin.json").exists()


def test_an_empty_reconstruction_is_told(folder, tmp_path):
    done = fit(
        folder,
        "--run",
        str(tmp_path / "empty"),
        "--phases.single_state.steps=2",
        "--phases.single_state.initial_opacity=0.1",
    )
    assert done.returncode == 2 and "nothing opaque" in done.stderr and "Traceback" not in done.stderr, done.stderr


def test_only_needs_what_comes_before(folder, tmp_path):
    done = fit(folder, "--run", str(tmp_path / "none"), "--only", "articulation")
    assert done.returncode == 2 and "single_state_0" in done.stderr and "Traceback" not in done.stderr


def test_the_papers_start_needs_a_number_of_parts(folder, tmp_path):
    done = fit(folder, "--run", str(tmp_path / "p"), "--phases.articulation.init=random", "--num_parts=auto")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "--num_parts N" in done.stderr
