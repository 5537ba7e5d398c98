"""A fit that is killed, starved of disk, locked out or told to stop ends in the same bytes when it is started again.
``make faults``."""

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections import Counter
from functools import partial

import pytest
from whole_runs import CPU, Fit, fit, make_whole

pytestmark = [pytest.mark.slow, pytest.mark.timeout(0)]
KILLS = int(os.environ.get("P2GS_KILLS", "100"))
KILLS_A_RUN = 5  # then it is let go to its end
STAGES = ("single_state_0", "single_state_1", "sharpen_0", "discovery", "canonical_fusion", "articulation", "finish")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return make_whole(tmp_path_factory.mktemp("faults"))


def one_sentence(ended, code, *texts):
    """It ended with the code, says the texts in its last line, and has no traceback."""
    assert ended.code == code and "Traceback" not in ended.said, ended.said
    assert all(text in ended.said.strip().splitlines()[-1] for text in texts), ended.said


def killed(whole, tmp_path, kills: int):
    """Runs that are killed ``kills`` times in all and go on end in the same bytes."""
    rng, at, runs = random.Random(kills), Counter(), 0
    while sum(at.values()) < kills:
        run, runs = tmp_path / f"run_{runs}", runs + 1
        for _ in range(min(KILLS_A_RUN, kills - sum(at.values()))):
            with Fit(whole.config, run) as one:
                if one.after(rng.randrange(whole.lines), rng.uniform(0, whole.gap)):
                    one.process.send_signal(signal.SIGKILL)
                    at[one.stage()] += 1
        whole.same(run, fit(whole.config, run))
        shutil.rmtree(run)
    print(f"\n{sum(at.values())} kills in {runs} runs: {dict(at)}")


def test_killed_at_random_moments(whole, tmp_path):
    killed(whole, tmp_path, KILLS)


def test_killed_at_random_moments_with_the_cpu_preset(tmp_path):
    killed(make_whole(tmp_path, CPU), tmp_path, max(KILLS // 10, 1))


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_result_of_a_stage_is_made_again(whole, tmp_path, seed):
    """A random byte flipped, or the file cut at a random place."""
    rng, run = random.Random(seed), tmp_path / "run"
    shutil.copytree(whole.run, run)
    path = run / "checkpoints" / f"{STAGES[seed % len(STAGES)]}.pt"
    data = bytearray(path.read_bytes())
    if seed % 2:
        del data[rng.randrange(len(data)) :]
    else:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)
    ended = fit(whole.config, run)
    whole.same(run, ended)
    assert ended.said.count("is damaged (") == 1 and f"{path} is damaged (" in ended.said and path.exists()
    assert ended.said.count("done before, unchanged") == 8, ended.said


@pytest.mark.parametrize("how", ["flipped", "cut"])
def test_a_damaged_training_state_is_told_and_left(whole, tmp_path, how):
    run = tmp_path / "run"
    path = run / "checkpoints" / "single_state_0.ckpt"
    with Fit(whole.config, run) as one:
        while not path.exists() and one.process.poll() is None:
            time.sleep(0.002)
        one.process.send_signal(signal.SIGKILL)
    data = bytearray(path.read_bytes())
    if how == "flipped":
        data[len(data) // 2] ^= 4
    path.write_bytes(data if how == "flipped" else data[: len(data) // 2])
    ended = fit(whole.config, run)
    whole.same(run, ended)
    assert "starting this stage anew" in ended.said


@pytest.mark.parametrize("limit_kb", [1, 60, 400])
def test_a_full_disk_is_told_and_the_run_goes_on(whole, tmp_path, limit_kb):
    """No file may grow beyond the limit: writes fail as on a full disk, at another stage for each."""
    run = tmp_path / "run"
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit_kb << 10, limit_kb << 10))
    ended = fit(whole.config, run, preexec_fn=limit)
    assert (
        ended.code in (1, 2)
        and "Traceback" not in ended.said
        and "error: " in ended.said
        and "File too large" in ended.said
    ), ended.said
    whole.same(run, fit(whole.config, run))


@pytest.fixture
def small_disk(tmp_path):
    """A function: mount a tmpfs of so many kB (root only)."""
    made = []

    def mount(kb):
        folder = tmp_path / "disk"
        folder.mkdir()
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={kb}k", "p2gs-faults", str(folder)], capture_output=True, text=True
        )
        if done.returncode:
            pytest.skip(f"no tmpfs can be mounted: {done.stderr.strip()}")
        made.append(folder)
        return folder

    yield mount
    for folder in made:
        subprocess.run(["umount", "-l", str(folder)], check=False)


@pytest.mark.parametrize("kb", [300, 1500])
def test_a_small_disk_is_told_and_the_run_goes_on_when_it_has_grown(whole, small_disk, kb):
    disk = small_disk(kb)
    ended = fit(whole.config, disk / "run")
    assert ended.code in (1, 2) and "Traceback" not in ended.said and "No space left on device" in ended.said, (
        ended.said
    )
    subprocess.run(["mount", "-o", "remount,size=200m", str(disk)], check=True)
    whole.same(disk / "run", fit(whole.config, disk / "run"))


def test_a_folder_that_cannot_be_written_to(whole, small_disk):
    disk = small_disk(200_000)
    with Fit(whole.config, disk / "run") as one:
        assert one.until("discovery: ")
        one.process.send_signal(signal.SIGKILL)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    one_sentence(fit(whole.config, disk / "run"), 1, "Read-only file system", "give the same command again")
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
    whole.same(disk / "run", fit(whole.config, disk / "run"))


def test_a_worker_that_is_killed(whole, tmp_path):
    run = tmp_path / "run"
    with Fit(whole.config, run) as one:
        assert one.until("single_state_0 ")
        for child in one.children():
            os.kill(child, signal.SIGKILL)
        one_sentence(one.ended(), 2, "single_state_1", "-9 (it was killed", "goes on where it stopped")
    whole.same(run, fit(whole.config, run))


def test_two_fits_in_one_folder(whole, tmp_path):
    run = tmp_path / "run"
    with Fit(whole.config, run) as one:
        assert one.next_line()
        one_sentence(fit(whole.config, run), 2, "another fit is running in this folder", f"process {one.process.pid} ")
        whole.same(run, one.ended())


@pytest.mark.parametrize("stage", ["single_state_0 ", "discovery: ", "canonical_fusion ", "articulation ", "finish: "])
def test_sigterm_of_a_scheduler(whole, tmp_path, stage):
    run = tmp_path / "run"
    with Fit(whole.config, run) as one:
        assert one.until(stage) or stage == "finish: "
        one.process.send_signal(signal.SIGTERM)
        ended = one.ended()
    if ended.code == 0:  # it was the last line of a run that had ended
        assert stage == "finish: "
    else:
        one_sentence(ended, 143, "stopped; give the same command again")
    whole.same(run, fit(whole.config, run))
