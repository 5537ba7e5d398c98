"""bench/steps.py: a step that changed something is left out, once, and is there again afterwards."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from p2gs.gaussians.handover import PartMotions

BENCH = Path(__file__).parents[2] / "bench"


@pytest.fixture
def steps(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCH))
    names = ("steps", "ladder")
    yield importlib.import_module("steps")
    for name in names:
        sys.modules.pop(name, None)


def motions(shift: float) -> PartMotions:
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, 0, 3] = shift
    return PartMotions(["prismatic"], T, torch.ones(1), [torch.ones(3).long()] * 2, [torch.ones(3)] * 2)


def test_each_step_is_where_it_is_said_to_be_and_comes_back(steps):
    for name, step in steps.STEPS.items():
        real = [getattr(where, step.name) for where in step.where]
        with steps.left_out(name):
            assert all(getattr(where, step.name) is not r for where, r in zip(step.where, real, strict=True))
        assert [getattr(where, step.name) for where in step.where] == real


def test_what_acted_is_told_and_then_left_out(steps, monkeypatch):
    before = motions(0.0)
    monkeypatch.setattr(steps.stage, "expand", lambda judge, given: (motions(0.1), [1]))
    monkeypatch.setattr(steps.stage, "settle_types", lambda judge, given, *rest: given)
    for name in ("in_two", "in_rows"):
        monkeypatch.setattr(steps.settle, name, lambda *given: ["proposal"])

    def discover():
        after, _ = steps.stage.expand(None, before)
        after = steps.stage.settle_types(None, after, 45.0, 0.002)
        assert steps.settle.in_two() == steps.settle.in_rows() == ["proposal"]
        after.diagnostics = {
            "reconsidered": [{"change": "parted", "energy": -0.1}, {"change": "in a row", "energy": 0.2}]
        }
        return after, 1.0

    def score(transforms, types, within):
        off = float(transforms[0, 0, 3])
        return {"right": int(off == 0), "of": 1, "extra": 0, "joints": [{"errors": [0.0, None, off]}]}

    phases = {"discovery": SimpleNamespace(config=SimpleNamespace(part_penalty=0.15))}
    case = SimpleNamespace(discover=discover, score=score, cfg=SimpleNamespace(phases=phases))
    rows = list(steps.rows_of(lambda: case, "it", ["labels by cuts", "types"], []))
    assert [row["without"] for row in rows] == [None, "labels by cuts"]  # types changed nothing
    # of what was proposed the parted ones were taken
    assert rows[0]["acted"] == ["labels by cuts", "parted"] and rows[0]["right"] == 0 and rows[1]["right"] == 1
    assert list(steps.rows_of(lambda: pytest.fail("known already"), "it", ["labels by cuts"], rows)) == []
