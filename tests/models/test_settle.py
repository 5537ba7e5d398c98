"""A part whose motion was fitted to the others' remains is asked for once more, and the photographs decide."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from test_finish import two_states
from tiny import hinge, slide

from p2gs.gaussians.handover import PartMotions
from p2gs.models.part_discovery import PartMotionsConfig
from p2gs.motion.directions import has_own_axis
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3
from p2gs.parts import settle
from p2gs.parts.part_choices import lonely, simplify, without_part
from p2gs.parts.seek import seek

COARSE = PolishConfig(steps=60, levels=[64], level_starts=[0.0], rate=5e-3, min_margin=0.0, free_static=0.0, front=-1.0)


NO_SURFACES = SimpleNamespace(search=None)  # found: nothing that the surfaces say counts in the energy


def judge_of(states, views):
    return Judge(NO_SURFACES, states, views, COARSE, [None, None], 0, "auto")


@pytest.fixture
def scene(monkeypatch):
    """A slide of one panel; labels are known, what the search would propose is told by the test."""
    states, labels, views = two_states(slide())
    margins = [torch.ones(len(labels))] * 2
    sure = SimpleNamespace(confidence=0.5)
    monkeypatch.setattr(
        "p2gs.motion.relabel.relabel", lambda found, transforms, types: SimpleNamespace(motions=[sure] * len(types))
    )
    monkeypatch.setattr("p2gs.motion.relabel.label_gaussians", lambda *a: ([labels, labels], margins))

    def reconsider(kind, T, proposed, more=(), limit=1):
        monkeypatch.setattr(
            settle, "instead_of", lambda found, transforms, types, part: more if part is None else proposed
        )
        motions = PartMotions([kind], T[None], torch.ones(1), [labels, labels], margins)
        return motions, *settle.reconsider(judge_of(states, views), motions, limit, PartMotionsConfig())

    return reconsider


def test_a_wrong_motion_is_exchanged_for_a_proposed_one_that_is_refined(scene):
    near = slide()
    near[:3, 3] += torch.tensor([0.02, -0.02, 0.02])
    wrong = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.tensor([-0.4, 0.5, 0]).double(), -1.1)
    _, found, log = scene("revolute", wrong, [(hinge(), "revolute"), (near, "prismatic")])
    assert found.types == ["prismatic"] and log[0]["type"] == "prismatic" and log[0]["change"] == "exchanged"
    assert float((found.transforms[0] - slide()).norm()) < 0.01  # refined, from 0.035
    assert (
        log[0]["after"] < log[0]["cost"]
        and log[0]["energy"] < log[0]["proposed"] < 0
        and found.confidence.tolist() == [0.5]
    )


def test_a_right_motion_stays(scene, monkeypatch):
    motions, found, log = scene("prismatic", slide(), [(hinge(), "revolute")])
    assert found is motions and len(log) == 1
    assert log[0]["proposed"] > settle.REACH and "energy" not in log[0]  # too far from a gain to be refined
    monkeypatch.setattr(settle, "REACH", math.inf)
    motions, found, log = scene("prismatic", slide(), [(hinge(), "revolute")])
    assert found is motions and len(log) == 1 and log[0]["energy"] > 0
    motions, found, log = scene("prismatic", slide(), [])
    assert found is motions and log == []


def test_a_further_part_must_win_by_more(scene):
    other = slide()
    other[:3, 3] *= -1
    motions, found, log = scene("prismatic", slide(), [], [(other, "prismatic")], limit=2)
    # no Gaussian is its own, the images stay as they are
    assert found is motions and [entry["change"] for entry in log] == ["added"]
    assert scene("prismatic", slide(), [], [(other, "prismatic")], limit=1)[2] == []  # no more parts than allowed


def second_owns_the_panel(monkeypatch):
    """States, labels, views and margins of one panel that slides, and its slide a little off; a second part, once there
    is one, owns it."""
    states, labels, views = two_states(slide())
    margins, sure = [torch.ones(len(labels))] * 2, SimpleNamespace(confidence=0.5)
    off = slide()
    off[:3, 3] += torch.tensor([0.0, 0.05, 0.0])
    monkeypatch.setattr(
        "p2gs.motion.relabel.relabel", lambda found, transforms, types: SimpleNamespace(motions=[sure] * len(types))
    )
    monkeypatch.setattr(
        "p2gs.motion.relabel.label_gaussians",
        lambda explanation, states: ([labels * len(explanation.motions)] * 2, margins),
    )
    return states, labels, views, margins, off


def test_a_further_part_must_explain_the_photographs_better(monkeypatch):
    """However much the surfaces gain by it."""
    states, labels, views, margins, off = second_owns_the_panel(monkeypatch)
    monkeypatch.setattr("p2gs.motion.refine_motions.surface_energy", lambda found, T, types: -10.0 * len(types))

    def added(start, further):
        monkeypatch.setattr(
            settle,
            "instead_of",
            lambda found, transforms, types, part: [(further, "prismatic")] if part is None else [],
        )
        motions = PartMotions(["prismatic"], start[None], torch.ones(1), [labels, labels], margins)
        return len(settle.reconsider(judge_of(states, views), motions, 2, PartMotionsConfig())[0])

    assert added(off, slide()) == 2 and added(slide(), -off + 2 * torch.eye(4).double()) == 1


def test_a_part_that_was_found_turned_over_is_turned_back(monkeypatch):
    """A door's panel, front for back about the middle of itself: only its texture tells."""
    states, labels, views = two_states(hinge())
    margins, sure = [torch.ones(len(labels))] * 2, SimpleNamespace(confidence=0.5)
    monkeypatch.setattr(
        "p2gs.motion.relabel.relabel", lambda found, transforms, types: SimpleNamespace(motions=[sure] * len(types))
    )
    monkeypatch.setattr("p2gs.motion.relabel.label_gaussians", lambda *a: ([labels, labels], margins))
    monkeypatch.setattr(settle, "instead_of", lambda *a: [])
    points = states[0].gaussians.means[labels == 1].double()
    upright = torch.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    upright = upright[(upright @ torch.tensor([0.0, 0.1, 1.0]).double()).abs().argmax()]
    over = se3.project_revolute(hinge() @ se3.from_screw(upright, points.mean(0), math.pi))
    motions = PartMotions(["revolute"], over[None], torch.ones(1), [labels, labels], margins)
    found, log = settle.reconsider(judge_of(states, views), motions, 1, PartMotionsConfig())
    assert log[0]["change"] == "turned over" and log[0]["energy"] < 0
    assert float((se3.apply(found.transforms[0], points) - se3.apply(hinge(), points)).norm(dim=1).mean()) < 0.02
    # right as it is
    motions = replace(motions, transforms=hinge()[None])
    assert settle.reconsider(judge_of(states, views), motions, 1, PartMotionsConfig())[0] is motions


def test_a_second_door_on_the_first_ones_line_is_not_alone():
    """As little as a further slide along another's direction: its axis is known."""
    states, labels, _ = two_states(hinge())
    cut = torch.where((labels == 1) & (states[0].gaussians.means[:, 2] > 0.1), 2, labels)
    margins = [torch.ones(len(cut))] * 2
    one = PartMotions(["revolute"], hinge()[None], torch.ones(1), [labels, labels], margins)

    def second(axis, origin, kind="revolute"):
        T = se3.from_screw(torch.tensor(axis).double(), torch.tensor(origin).double(), 0.7)
        if kind == "prismatic":
            T[:3, :3] = torch.eye(3)
        return PartMotions(["revolute", kind], torch.stack([hinge(), T]), torch.ones(2), [cut, cut], margins)

    line, other = [0.0, 0.1, 1.0], [-0.4, 0.5, 0.0]
    assert not lonely(states, second(line, [0.4, 0.5, 0.0]), one, 1)  # the same line, 40 degrees for 29
    assert not lonely(states, second([0.0, -0.1, -1.0], [0.4, 0.52, 0.1]), one, 1)  # nearly, the other way
    assert lonely(states, second(line, other), one, 1)
    assert lonely(states, second(line, [0.4, 0.5, 0.0], "prismatic"), one, 1)
    assert not lonely(states, one, one, 0)  # no axis more
    tilted = second([0.0, 0.15, 1.0], [0.4, 0.5, 0.0])  # by three degrees: as good as one line while motions are coarse
    assert has_own_axis(states, tilted, 1) and not has_own_axis(states, tilted, 1, coarse=True)
    assert not has_own_axis(states, second(line, [0.4, 0.5, 0.0]), 1)


def test_what_is_sought_must_save_its_share_once_refined(monkeypatch):
    """The panel that slides was taken for static, as another's motion was known alone."""
    states, labels, views = two_states(slide())
    margins, sure = [torch.ones(len(labels))] * 2, SimpleNamespace(confidence=0.5)
    monkeypatch.setattr(
        "p2gs.motion.relabel.relabel", lambda found, transforms, types: SimpleNamespace(motions=[sure] * len(types))
    )
    monkeypatch.setattr(
        "p2gs.motion.relabel.label_gaussians",
        lambda explanation, states: ([labels * len(explanation.motions)] * 2, margins),
    )
    near = slide()
    near[:3, 3] += torch.tensor([0.02, -0.02, 0.02])
    first = PartMotions(["prismatic"], slide()[None], torch.ones(1), [torch.zeros_like(labels)] * 2, margins)
    away = torch.eye(4).double()
    away[:3, 3] = torch.tensor([-0.5, 0.3, 0.4])
    for proposed, parts in (([(away, "prismatic"), (near, "prismatic")], 2), ([(away, "prismatic")], 1), ([], 1)):
        monkeypatch.setattr(
            "p2gs.parts.seek.left_over", lambda found, T, types, proposed=proposed: proposed if len(types) == 1 else []
        )
        motions, log = seek(judge_of(states, views), first, 3, PartMotionsConfig())
        assert len(motions) == parts and all(entry["change"] == "sought" for entry in log)
        if parts == 2:
            assert float((motions.transforms[1] - slide()).norm()) < 0.01
    assert len(seek(judge_of(states, views), first, 1, PartMotionsConfig())[0]) == 1  # no more parts than allowed


def test_an_only_part_that_energy_asks_for_need_not_save_its_share(monkeypatch):
    """Its motion may be far off yet, and nothing can be exchanged where nothing is left. A further part must."""
    states, labels, views = two_states(slide())
    margins = [torch.ones(len(labels))] * 2
    off = torch.eye(4).double()
    off[:3, 3] = torch.tensor([0.1, 0.4, 0.3])
    monkeypatch.setattr("p2gs.motion.refine_motions.surface_energy", lambda found, T, types: -9.0 * len(types))
    judge = replace(judge_of(states, views), further=0.9)
    only = PartMotions(["prismatic"], off[None], torch.ones(1), [labels, labels], margins)
    assert judge.own_share(only, without_part(only, 0, 0)) < 0.9
    assert simplify(judge, only, 0.0) is only
    T = torch.stack([off, se3.from_screw(torch.tensor([0.0, 1, 0]).double(), torch.zeros(3).double(), 0.8)])
    two = PartMotions(["prismatic", "revolute"], T, torch.ones(2), [2 * labels, 2 * labels], margins)
    log: list[dict] = []
    assert len(simplify(judge, two, 0.0, log)) == 1 and len(log) == 1


def test_two_bodies_with_amounts_of_their_own_are_taken_where_the_energy_falls(monkeypatch):
    states, labels, views, margins, off = second_owns_the_panel(monkeypatch)
    monkeypatch.setattr(settle, "instead_of", lambda *a: [])
    monkeypatch.setattr(
        settle, "in_two", lambda found, T, types: [(0, torch.stack([T[0], slide()]), [*types, "prismatic"])]
    )
    motions = PartMotions(["prismatic"], off[None], torch.ones(1), [labels, labels], margins)
    for price, parts in ((0.01, 2), (9.0, 1)):
        monkeypatch.setattr(
            "p2gs.motion.refine_motions.surface_energy", lambda found, T, types, price=price: price * len(types)
        )
        found, log = settle.reconsider(judge_of(states, views), motions, 2, PartMotionsConfig())
        assert len(found) == parts and log[0]["change"] == "parted"
