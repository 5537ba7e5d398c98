"""bench/arms.py: what an arm takes over from a run, and what its tables average."""

import importlib
import sys
from pathlib import Path

import pytest


@pytest.fixture
def arms(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "bench"))
    yield importlib.import_module("arms")
    for name in ("arms", "ladder", "measured"):
        sys.modules.pop(name, None)


def test_a_run_hands_over_its_stages_up_to_fusion_once(arms, tmp_path):
    run, out = tmp_path / "door", tmp_path / "out"
    for name in ("discovery.pt", "canonical_fusion.pt", "articulation.pt", "articulation.ckpt", "finish.pt"):
        path = run / "checkpoints" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    made = Path(arms.folder(out, "full", "door")) / "checkpoints"
    (made.parent / "checkpoints.part").mkdir(parents=True)  # a copy that was cut off
    (made.parent / "checkpoints.part" / "half.pt").touch()
    arms.hand_over(run, out)
    assert sorted(p.name for p in made.iterdir()) == ["canonical_fusion.pt", "discovery.pt"]
    (made / "articulation.pt").write_text("the arm's own")
    arms.hand_over(run, out)
    assert (made / "articulation.pt").read_text() == "the arm's own"


def test_an_object_counts_when_all_of_its_arms_are_finished(arms, tmp_path):
    for arm in arms.ARMS:
        for name in ("door", "lid"):
            folder = arms.folder(tmp_path, arm, name)
            folder.mkdir(parents=True)
            if (arm, name) != ("no_articulation", "lid"):
                (folder / "metrics.json").write_text("{}")
    assert arms.finished(tmp_path) == ["door"]


def test_tables_average_what_was_found_and_say_how_much(arms):
    def arm(axis, joints, turn=None):
        return arms.Arm(axis, joints, 0.01, turn, None, 0.02, 30.0, None)

    found = {
        name: {"door": arm((1.0, 0.5, end), (1, 1, 1), 0.2), "lid": arm((None, None, None), (0, 0, 2))}
        for name, end in zip(arms.ARMS, (0.25, 0.1, 0.2, 0.3), strict=True)
    }
    axis = arms.axis_rows(found, ["door", "lid"])
    assert axis[0] == ["*after discovery*", "*1.000*", "*-*", "*1.000*"]
    assert axis[1][1:] == ["0.500 -> 0.250", "- -> -", "0.500 -> 0.250"]
    end = arms.end_rows(found, ["door", "lid"])[0]
    assert end[1:] == ["2.00", "2.00", "2.00", "1 / 1 of 3", "1.0", "0.200", "-", "-", "30.00"]
