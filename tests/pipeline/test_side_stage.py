"""The two single states at once, each in a process: the same bits as one after the other; an interrupt, a mistake, a
lost process."""

import json
import signal
import subprocess
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from one_stage import REPO, command, environment

from p2gs.callbacks.base import Callback, register_callback
from p2gs.config.run import load_config
from p2gs.gaussians import handover
from p2gs.runtime.side_stage import SideStage, can_run_beside
from p2gs.types import UserError

STATES = """
include: [{repo}/configs/preset/smoke.yaml]
data: {{format: synthetic, root: {root}, kind: demo, size: 48, train_views: 8, test_views: 1, depth: never}}
phases: {{single_state: {{steps: {steps}, initial_gaussians: 800, levels: [24, 48], level_starts: [0.0, 0.3],
    callbacks: {{densify: {{budget: 1000, every: 20}}}}}}}}
callbacks: {{checkpoint: {{every: 5}}}}
"""


def config(folder: Path, steps: int = 60) -> Path:
    path = folder / f"states_{steps}.yaml"
    path.write_text(STATES.format(repo=REPO, root=folder / "scene", steps=steps))
    return path


def test_both_states_at_once_give_the_bits_of_one_after_the_other(tmp_path):
    runs = {threads: tmp_path / str(threads) for threads in (1, 2)}
    for threads, run in runs.items():
        done = subprocess.run(
            command(config(tmp_path), run, threads), capture_output=True, text=True, timeout=200, env=environment()
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "single_state_1 60/60" in done.stdout  # the other process is heard
        times = json.loads((run / "logs" / "stages.json").read_text())
        assert set(times) == {"single_state_0", "single_state_1"} and all(t["seconds"] > 0 for t in times.values())
    for name in ("single_state_0", "single_state_1"):
        one, two = (handover.load(run / "checkpoints" / f"{name}.pt") for run in runs.values())
        assert one[1] == two[1]  # the same key
        for field in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            assert torch.equal(getattr(one[0].gaussians, field), getattr(two[0].gaussians, field)), field


def test_an_interrupt_stops_both_and_keeps_what_they_have(tmp_path):
    run = tmp_path / "run"
    started = command(config(tmp_path, 20000), run, 2)
    # what a script starts in the background ignores interrupts, and so would what is started here
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(
        started, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment(), preexec_fn=heed
    )
    saved = [run / "checkpoints" / f"single_state_{s}.ckpt" for s in (0, 1)]
    deadline = time.time() + 100
    while not all(p.exists() for p in saved) and process.poll() is None and time.time() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=100)[0]  # the pipe closes when the other process has ended, too
    assert process.returncode == 130 and "stopped" in said and "Traceback" not in said, said
    for path in saved:
        state = torch.load(path, weights_only=True)
        done = state["loops"]["fit_loop"]["epoch_loop.batch_progress"]["total"]
        assert state["global_step"] == done["completed"] > 0  # between two steps


def test_a_mistake_is_told_as_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a long path is told shortened
    with SideStage(Path("nothing"), "single_state_1", 1) as other, pytest.raises(UserError, match="config.yaml"):
        other.wait()


def test_a_lost_process_is_told(tmp_path, capfd):
    with SideStage(tmp_path, "single_state_1", 1) as other:
        other.process.kill()
        with pytest.raises(UserError, match="single_state_1.*ended with code -9"):
            other.wait()


def test_what_only_this_program_knows_is_not_run_beside(tmp_path):
    @register_callback("side_stage_test_only")
    class Own(Callback):
        pass

    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        plain = load_config([str(config(tmp_path))])
        assert can_run_beside(plain, torch.device("cpu"))
        own = load_config([str(config(tmp_path))], ["--callbacks.side_stage_test_only", "{}"])
        assert not can_run_beside(own, torch.device("cpu"))
        watched = load_config([str(config(tmp_path))], ["--callbacks.viewer", "{}"])
        assert not can_run_beside(watched, torch.device("cpu"))
        torch.set_num_threads(1)
        assert not can_run_beside(plain, torch.device("cpu"))
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("mode, beside", [("Default", True), ("Exclusive_Process", False), (None, False)])
def test_a_gpu_of_one_process_trains_one_state_after_the_other(mode, beside, tmp_path, monkeypatch):
    def nvidia_smi(words, **options):
        assert words[:3] == ["nvidia-smi", "-i", "GPU-4f6e"]
        if mode is None:
            raise FileNotFoundError(words[0])
        return subprocess.CompletedProcess(words, 0, mode + "\n")

    monkeypatch.setattr("p2gs.runtime.side_stage.subprocess.run", nvidia_smi)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid="4f6e"))
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    cfg = load_config([str(config(tmp_path))])
    assert can_run_beside(cfg, torch.device("cuda")) == beside
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace())  # an old torch
    assert not can_run_beside(cfg, torch.device("cuda"))
