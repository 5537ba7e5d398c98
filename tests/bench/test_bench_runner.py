"""Running a bench: every run in its own process and folder, failures noted and not fatal, killed benches go on, three
executors."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from p2gs.bench.cell import is_done, note, read_record, status
from p2gs.bench.live import Display
from p2gs.bench.plan import read_bench
from p2gs.bench.runner import run_bench

BENCH = """
from p2gs.bench.plan import read_bench
from p2gs.bench.runner import run_bench

run_bench(read_bench([{path!r}]), program={program!r})
"""
ONE = "settings: {full: {}}\nseeds: [0]\n"


def run(bench, program, **options):
    """Counts and what was printed."""
    out = io.StringIO()
    with redirect_stdout(out):
        counts = run_bench(bench, program=program, **options)
    return dict(counts), out.getvalue()


def test_every_run_is_fit_exported_and_tested_once(bench_file, program):
    bench = read_bench([bench_file()])
    counts, text = run(bench, program)
    assert counts == {"done": 8} and all(is_done(c) for c in bench.cells)
    assert [len(program.calls(command)) for command in ("fit", "export", "test")] == [8, 8, 8]
    cell = bench.cells[-1]
    record = read_record(cell.run)
    assert (record["object"], record["setting"], record["seed"], record["status"]) == ("laptop", "no_repel", 1, "done")
    assert record["seconds"] > 0
    assert f"$ p2gs fit {' '.join(cell.words)}" in (Path(cell.run) / "bench.log").read_text()
    assert "8 of 8 runs done" in text and "[8/8] laptop no_repel seed 1: done" in text and " left\n" in text
    counts, text = run(read_bench([bench_file()]), program)
    assert counts == {"done": 8} and len(program.calls("fit")) == 8 and "8 done before" in text


def test_a_run_takes_over_finished_stages_of_the_settings_before(bench_file, program):
    bench = read_bench([bench_file("settings: {full: {}, no_repel: {}, no_part: {}}\nseeds: [0]\n")])
    run(bench, program)
    first = {c.object: c.run for c in bench.cells if c.setting == "full"}
    for cell in bench.cells:
        assert (Path(cell.run) / "checkpoints" / "single_state_0.pt").read_text() == f"made in {first[cell.object]}"
    alone = read_bench(
        [bench_file("settings: {full: {}, no_repel: {}}\nseeds: [0]\nreuse: false\n")],
        ["--out", str(bench.options.folder) + "2"],
    )
    run(alone, program)
    for cell in alone.cells:
        assert (Path(cell.run) / "checkpoints" / "single_state_0.pt").read_text() == f"made in {cell.run}"


@pytest.mark.parametrize(
    ("fail", "error"),
    [
        ("laptop", "the sky fell"),
        ("KILL", "killed by SIGKILL"),
        ("SILENT", "p2gs test ended without metrics.json"),
    ],
)
def test_a_run_that_fails_is_noted_and_tried_again(bench_file, program, monkeypatch, fail, error):
    monkeypatch.setenv("FAKE_P2GS_FAIL", fail)
    bench = read_bench([bench_file(ONE)])
    counts, text = run(bench, program)
    failed = [c for c in bench.cells if status(c) == "failed"]
    assert counts.get("failed", 0) == len(failed) == (1 if fail == "laptop" else 2)
    assert all(read_record(c.run)["error"] == error for c in failed) and f"FAILED: {error}" in text
    before = len(program.calls("fit"))
    counts, _ = run(read_bench([bench_file(ONE)]), program, skip_failed=True)
    assert counts["failed"] == len(failed) and len(program.calls("fit")) == before
    monkeypatch.delenv("FAKE_P2GS_FAIL")
    assert run(read_bench([bench_file(ONE)]), program)[0] == {"done": 2}
    assert len(program.calls("fit")) == before + len(failed)


def test_a_run_that_takes_too_long_is_stopped(bench_file, program, monkeypatch):
    monkeypatch.setenv("FAKE_P2GS_SLEEP", "60")
    bench = read_bench([bench_file(ONE + "timeout_minutes: 0.002\n")], [], ["laptop"])
    assert run(bench, program)[0] == {"failed": 1}
    assert read_record(bench.cells[0].run)["error"] == "took longer than 0.002 minutes"


def test_a_run_whose_scores_were_deleted_is_run_again(bench_file, program):
    bench = read_bench([bench_file(ONE)])
    run(bench, program)
    (Path(bench.cells[0].run) / "metrics.json").unlink()
    assert sorted(status(c) for c in bench.cells) == ["done", "todo"]
    assert run(bench, program)[0] == {"done": 2} and is_done(bench.cells[0])


def test_scores_of_another_config_do_not_count(bench_file, program):
    run(read_bench([bench_file(ONE)]), program)
    changed = read_bench([bench_file(ONE)], ["--phases.articulation.steps", "9"])
    assert [status(c) for c in changed.cells] == ["todo", "todo"]
    run(changed, program)
    assert len(program.calls("fit")) == 4 and not is_done(read_bench([bench_file(ONE)]).cells[0])


def test_processes_share_the_cores(bench_file, program, monkeypatch):
    monkeypatch.setattr("p2gs.bench.executors.cores", lambda: 8)
    bench = read_bench([bench_file(ONE)], ["--processes", "2"])
    run(bench, program)
    assert all("--threads 4" in line for line in program.calls("fit"))
    assert all(json.loads((Path(c.run) / "metrics.json").read_text())["threads"] == "4" for c in bench.cells)


def test_a_killed_bench_loses_at_most_the_runs_that_were_running(bench_file, program, monkeypatch, tmp_path):
    """SIGKILL, so that nothing can be tidied up: even the orphaned run is waited for, not joined."""
    monkeypatch.setenv("FAKE_P2GS_SLEEP", "0.7")
    path = bench_file("settings: {full: {}}\nseeds: [0, 1, 2]\nprocesses: 2\n")
    code = BENCH.format(path=path, program=tuple(program))
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    bench = read_bench([path])
    until = time.monotonic() + 60
    while sum(map(is_done, bench.cells)) < 2 or not any(status(c) == "running" for c in bench.cells):
        assert time.monotonic() < until and child.poll() is None
        time.sleep(0.02)
    child.send_signal(signal.SIGKILL)
    child.wait()
    done, running = ([c for c in bench.cells if status(c) == kind] for kind in ("done", "running"))
    assert len(done) >= 2 and 1 <= len(running) <= 2
    counts, _ = run(read_bench([path]), program)
    assert counts == {"done": 6}  # a second process in the folder of the orphan would have failed
    fits = {c.run: sum(c.run in line for line in program.calls("fit")) for c in bench.cells}
    assert all(fits[c.run] == 1 for c in done) and all(n <= 2 for n in fits.values())


def test_a_terminated_bench_ends_its_runs(bench_file, program, monkeypatch):
    monkeypatch.setenv("FAKE_P2GS_SLEEP", "30")
    path = bench_file(ONE)
    code = BENCH.format(path=path, program=tuple(program))
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    cell = read_bench([path]).cells[0]
    until = time.monotonic() + 60
    while not program.calls("fit"):
        assert time.monotonic() < until and child.poll() is None
        time.sleep(0.02)
    child.terminate()
    assert "KeyboardInterrupt" in child.communicate(timeout=20)[1]
    assert read_record(cell.run)["status"] == "stopped" and status(cell) == "stopped"


def test_the_live_matrix_has_a_sign_a_run_and_the_time_left(bench_file):
    from rich.console import Console

    bench = read_bench([bench_file()])
    known = {c.name: "todo" for c in bench.cells}
    known |= {"cabinet full seed 0": "done", "cabinet full seed 1": "failed", "laptop full seed 0": "running"}
    show = Display(bench, terminal=False)
    with redirect_stdout(io.StringIO()), show.on(known, 2):
        show.seconds, show.errors = [100.0, 20.0], [("cabinet full seed 1", "the sky fell")]
        show.began = {"laptop full seed 0": time.monotonic() - 10}
        console = Console(file=io.StringIO(), width=100)
        console.print(show.matrix())
    lines = console.file.getvalue().splitlines()
    assert any(line.split() == ["cabinet", "●F", "··"] for line in lines) and any(
        line.split() == ["laptop", "▶·", "··"] for line in lines
    )
    # (5 * 60 + 50) / 2
    assert "2/8 runs, about 2:55 left" in console.file.getvalue() and "the sky fell" in console.file.getvalue()


# -- clusters ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cluster", ["debug", "local"])
def test_slurm_by_submitits_own_executors(bench_file, program, monkeypatch, cluster):
    pytest.importorskip("submitit")
    monkeypatch.setenv("FAKE_P2GS_FAIL", "laptop")
    bench = read_bench(
        [bench_file(f"{ONE}executor: slurm\nslurm: {{cluster: {cluster}, jobs: 2, cpus: 3, minutes: 5}}\n")]
    )
    counts, _ = run(bench, program)
    assert counts == {"done": 1, "failed": 1}
    assert read_record(bench.cells[1].run)["error"] == "the sky fell" and "--threads 3" in program.calls("fit")[0]


def test_ray(bench_file, program, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("FAKE_P2GS_FAIL", "laptop")
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    bench = read_bench([bench_file(f"{ONE}executor: ray\nray: {{cpus: 1}}\n")])
    counts, _ = run(bench, program)
    assert counts == {"done": 1, "failed": 1}
    assert read_record(bench.cells[1].run)["error"] == "the sky fell" and "--threads 1" in program.calls("fit")[0]


@pytest.mark.parametrize(("name", "module"), [("slurm", "submitit"), ("ray", "ray")])
def test_a_missing_library_is_told(bench_file, program, monkeypatch, name, module):
    from p2gs.types import UserError

    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=f"executor: {name} needs .*pip install 'p2gs\\[{name}\\]'"):
        run(read_bench([bench_file(ONE)], ["--executor", name]), program)


class Losing:
    """An executor that loses the first ``times`` jobs of every run, after ``before(cell)``."""

    slots = 1

    def __init__(self, work, times, before=None):
        self.work, self.times, self.before, self.begun = work, times, before, Counter()

    def start(self, cell):
        self.begun[cell.name] += 1
        lost = self.begun[cell.name] <= self.times
        if not lost or self.before is not None:
            (self.work if not lost else self.before)(cell)
        return Job(lost, self.work if not lost else None, cell)

    def close(self, stop): ...


class Job:
    def __init__(self, lost, work, cell):
        self.lost, self.work, self.cell = lost, work, cell

    def done(self):
        return True

    def result(self):
        if self.lost:
            raise RuntimeError("the node\nis gone")
        return self.work(self.cell)


@pytest.mark.parametrize(
    ("times", "counts"), [(1, {"done": 2}), (2, {"done": 2}), (3, {"failed": 2}), (99, {"failed": 2})]
)
def test_a_lost_job_is_handed_over_again_twice(bench_file, program, monkeypatch, times, counts):
    from p2gs.bench import runner

    places = []
    monkeypatch.setattr(runner, "executor", lambda options, work: places.append(Losing(work, times)) or places[0])
    bench = read_bench([bench_file(ONE)])
    found, text = run(bench, program)
    assert found == counts and text.count("lost (the node is gone); again") == 2 * min(times, runner.LOST_AGAIN)
    assert all(n == min(times, runner.LOST_AGAIN) + 1 for n in places[0].begun.values())
    if counts == {"failed": 2}:
        assert read_record(bench.cells[0].run)["error"] == "the node is gone" and os.path.isdir(bench.cells[0].run)
    else:
        assert all(is_done(c) and read_record(c.run)["status"] == "done" for c in bench.cells)


def test_a_run_that_ended_though_its_job_was_lost_is_not_run_twice(bench_file, program, monkeypatch):
    from p2gs.bench import runner

    monkeypatch.setattr(runner, "executor", lambda options, work: Losing(work, 1, before=work))
    bench = read_bench([bench_file(ONE)])
    assert run(bench, program)[0] == {"done": 2}
    assert len(program.calls("fit")) == 2 and all(read_record(c.run)["status"] == "done" for c in bench.cells)


@pytest.mark.parametrize("told", ["failed", "running"])
def test_a_run_whose_job_was_lost_as_it_ended_is_noted_as_done(bench_file, program, monkeypatch, told):
    """Its node went between the scores and the note, or was told to be gone before either."""
    from p2gs.bench import runner

    def ended(work):
        def carry_out(cell):
            work(cell)
            note(cell, status=told, seconds=7.0, error=None)

        return carry_out

    monkeypatch.setattr(runner, "executor", lambda options, work: Losing(work, 1, before=ended(work)))
    bench = read_bench([bench_file(ONE)])
    assert run(bench, program)[0] == {"done": 2} and len(program.calls("fit")) == 2
    records = [read_record(c.run) for c in bench.cells]
    assert all((r["status"], r["seconds"], r["error"]) == ("done", 7.0, None) for r in records)
