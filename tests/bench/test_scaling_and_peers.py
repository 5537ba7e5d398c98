"""``p2gs bench scaling`` and ``p2gs bench peers``: settings, exponents, tables; the peer is a stand-in."""

import json
import sys
from pathlib import Path

import pytest
import torch

from p2gs.bench import peers, scaling
from p2gs.cli import main
from p2gs.data.generated.generate import synthesize

STAND_IN = Path(__file__).with_name("fake_splat.py")


def test_every_setting_is_measured_once():
    settings = scaling.plan(scaling.GROWTH, scaling.BASE)
    assert len(settings) == 7 and settings.count(scaling.BASE) == 1
    assert all(sum(s[n] != scaling.BASE[n] for n in s) <= 1 for s in settings)


def test_exponents_are_slopes():
    sizes, base = {"px": (10, 20, 40)}, {"px": 20}
    rows = [scaling.Measured(px, 1, 1, 1, 3.0 * px**2, 7.0, px**3, 1.0 + px**2) for px in (10, 20, 40)]
    found = scaling.exponents(rows, sizes, base)["px"]
    assert found["step_ms"]["all"] == pytest.approx(1) and found["prepare_s"]["all"] == pytest.approx(0)
    assert found["depth_s"]["last"] == pytest.approx(1.5) and 0.9 < found["memory_mib"]["all"] < 1
    text = scaling.markdown(rows, {"px": found})
    assert "| 10 | 1 | 1 | 300.0 | 7.00 |" in text and "| number of pixels | 1.00 (1.00) | 0.00 (0.00) |" in text


def test_scaling_runs_and_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scaling, "QUICK", {"px": (32, 48), "gaussians": (300, 600)})
    monkeypatch.setattr(scaling, "QUICK_BASE", {"px": 48, "views": 2, "gaussians": 300})
    assert main(["bench", "scaling", "--quick", "--steps", "4", "--out", str(tmp_path)]) == 0
    told = json.loads((tmp_path / "scaling.json").read_text())
    assert len(told["rows"]) == 3 and all(r["step_ms"] > 0 for r in told["rows"])
    assert all(r["memory_mib"] >= 0 for r in told["rows"])  # so small a state may fit in what loading took
    assert (tmp_path / "scaling.md").read_text() in capsys.readouterr().out and (tmp_path / "scaling.png").is_file()


@pytest.mark.parametrize("words", [["--threads", "0"], ["--steps", "1"]])
def test_scaling_names_mistakes(words, capsys):
    assert main(["bench", "scaling", *words]) == 2 and "expected at least" in capsys.readouterr().err


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("peers") / "scene"
    return synthesize(folder, seed=0, kind="demo", size=48, train_views=9, test_views=0, depth=False)


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "splatter"
    path.write_text(f'#!/bin/sh\nexec {sys.executable} {STAND_IN} "$@"\n')
    path.chmod(0o755)
    return str(path)


SHORT = ["--phases.single_state.steps", "40", "--phases.single_state.initial_gaussians", "300"]


def test_peers(scene, program, tmp_path, capsys):
    words = ["bench", "peers", "--program", program, "--root", str(scene), "--out", str(tmp_path / "out"), *SHORT]
    assert main(words) == 0, capsys.readouterr().err
    told = json.loads((tmp_path / "out" / "peers.json").read_text())
    for points in told.values():
        assert [p["step"] for p in points] == list(range(2, 41, 2))
        assert all(a["seconds"] <= b["seconds"] for a, b in zip(points, points[1:], strict=False))
    text = capsys.readouterr().out
    assert (
        "| test PSNR, dB | p2gs, s (CPU s) | splatter, s (CPU s) | times as long (in CPU time) |" in text
        and "splatter: 40 steps in" in text
    )
    frames = json.loads((tmp_path / "out" / "project" / "transforms.json").read_text())["frames"]
    assert len(frames) == 7  # nine less every eighth, which are the test views


def test_the_same_views_for_both(scene):
    task, cfg = peers.make_task(str(scene), 1, SHORT)
    assert len(task.train) == 7 and len(task.test) == 2
    shot = task.train.get(0, 0, torch.tensor(peers.BACKGROUND))
    assert torch.allclose(shot.image[0, 0], torch.tensor(peers.BACKGROUND), atol=1e-6)


def test_time_to_a_level():
    points = [peers.Point(s, s / 2, 10, db, 1) for s, db in ((1.0, 20.0), (2.0, 25.0), (3.0, 24.0))]
    assert [p and p.seconds for p in (peers.time_to(points, x) for x in (19, 20.5, 25, 26))] == [1.0, 2.0, 2.0, None]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--program", "no_such_program"], "there is no program no_such_program"),
        (["--", "--fail"], "ended with code 3: no such thing"),
    ],
)
def test_peers_names_mistakes(scene, program, tmp_path, words, told, capsys):
    given = ["--root", str(scene), "--out", str(tmp_path / "out"), *SHORT]
    given += [] if words[0] == "--program" else ["--program", program]
    assert main(["bench", "peers", *given, *words]) == 2
    assert told in capsys.readouterr().err
