"""The words of ``p2gs bench`` and ``p2gs table``."""

import sys
from types import ModuleType

from p2gs.app import run

ONE = "settings: {full: {}}\nseeds: [0]\n"


def test_dry_run_prints_the_commands_and_runs_nothing(bench_file, tmp_path, capsys):
    words = [
        "bench",
        "-c",
        bench_file(ONE),
        "--objects",
        "laptop",
        "--seeds",
        "4",
        "5",
        "--out",
        str(tmp_path / "o"),
        "--dry_run",
    ]
    assert run([*words, "--phases.single_state.steps", "9"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[0] for line in lines] == ["laptop full seed 4", "laptop full seed 5"]
    assert (
        all(f"--phases.single_state.steps 9 --run {tmp_path / 'o'}" in line for line in lines)
        and not (tmp_path / "o").exists()
    )


def test_a_bench_that_has_failures_says_so_by_its_exit_code(bench_file, program, monkeypatch, capsys):
    from p2gs.bench import runner

    plain = runner.run_bench
    monkeypatch.setattr(runner, "run_bench", lambda bench, **options: plain(bench, program=program, **options))
    monkeypatch.setenv("FAKE_P2GS_FAIL", "laptop")
    path = bench_file(ONE)
    assert run(["bench", "-c", path]) == 1
    monkeypatch.delenv("FAKE_P2GS_FAIL")
    assert run(["bench", "-c", path, "--skip_failed"]) == 1 and run(["bench", "-c", path]) == 0
    assert "p2gs table" in capsys.readouterr().out


def test_mistakes_are_one_line(bench_file, capsys, tmp_path):
    for words, told in (
        (["bench"], "bench needs a file"),
        (["bench", "-c", "bench/pariss.yaml"], "did you mean 'bench/paris.yaml'?"),
        (
            ["bench", "-c", bench_file(ONE), "--phases.articulation.stepps", "3"],
            "no option 'phases.articulation.stepps'",
        ),
        (["bench", "-c", bench_file(ONE), "--executor", "slrum"], "one of local, slurm, ray"),
        (["table", str(tmp_path / "nothing")], "no result folder of p2gs bench"),
    ):
        assert run(words) == 2
        err = capsys.readouterr().err
        assert err.startswith("error: ") and told in err and err.count("\n") == 1, err


def test_kernels_have_options_of_their_own(monkeypatch):
    taken = []
    kernels = ModuleType("p2gs.bench.kernels")
    kernels.main = lambda words: taken.append(words) or 0
    monkeypatch.setitem(sys.modules, "p2gs.bench.kernels", kernels)
    assert run(["bench", "kernels", "--out", "x", "--size", "4"]) == 0 and taken == [["--out", "x", "--size", "4"]]
