"""A part whose motion was fitted to the others' remains is asked for once more, and the photographs decide."""

from types import SimpleNamespace

import pytest
import torch
from test_finish import two_states
from tiny import hinge, slide

from p2gs.models import settle
from p2gs.models.handover import PartMotions
from p2gs.models.part_motions import PartMotionsConfig, _contenders
from p2gs.models.screw_polish import PolishConfig
from p2gs.ops import se3

COARSE = PolishConfig(steps=60, levels=[64], level_starts=[0.0], rate=5e-3, min_margin=0.0, free_static=0.0, front=-1.0)


NO_SURFACES = SimpleNamespace(search=None)  # found: nothing that the surfaces say counts in the energy


@pytest.fixture
def scene(monkeypatch):
    """A slide of one panel; labels are known, what the search would propose is told by the test."""
    states, labels, views = two_states(slide())
    margins = [torch.ones(len(labels))] * 2
    sure = SimpleNamespace(confidence=0.5)
    monkeypatch.setattr(settle, "relabel", lambda found, transforms, types: SimpleNamespace(motions=[sure] * len(types)))
    monkeypatch.setattr(settle, "label_gaussians", lambda *a: ([labels, labels], margins))

    def reconsider(kind, T, proposed, more=(), limit=1):
        monkeypatch.setattr(settle, "instead_of", lambda found, transforms, types, part: more if part is None else proposed)
        motions = PartMotions([kind], T[None], torch.ones(1), [labels, labels], margins)
        config = PartMotionsConfig(coarse=COARSE, split_reach=0.0)
        return motions, *settle.reconsider(NO_SURFACES, states, motions, views, config, [None, None], limit, seed=0, backend="auto")

    return reconsider


def test_a_wrong_motion_is_exchanged_for_a_proposed_one_that_is_refined(scene):
    near = slide()
    near[:3, 3] += torch.tensor([0.02, -0.02, 0.02])
    wrong = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.tensor([-0.4, 0.5, 0]).double(), -1.1)
    _, found, log = scene("revolute", wrong, [(hinge(), "revolute"), (near, "prismatic")])
    assert found.types == ["prismatic"] and log[0]["type"] == "prismatic" and log[0]["change"] == "exchanged"
    assert float((found.transforms[0] - slide()).norm()) < 0.01  # refined, from 0.035
    assert log[0]["after"] < log[0]["tried"] < log[0]["before"] and found.confidence.tolist() == [0.5]


def test_a_right_motion_stays(scene):
    motions, found, log = scene("prismatic", slide(), [(hinge(), "revolute")])
    assert found is motions and len(log) == 1 and log[0]["tried"] > log[0]["before"] and log[0]["after"] is None  # not worth refining
    motions, found, log = scene("prismatic", slide(), [])
    assert found is motions and log == []


def test_a_further_part_must_win_by_more(scene):
    other = slide()
    other[:3, 3] *= -1
    motions, found, log = scene("prismatic", slide(), [], [(other, "prismatic")], limit=2)
    assert found is motions and [entry["change"] for entry in log] == ["added"]  # no Gaussian is its own, the images stay as they are
    assert scene("prismatic", slide(), [], [(other, "prismatic")], limit=1)[2] == []  # no more parts than allowed


@pytest.mark.parametrize(("confidence", "evidence", "taken"), [(0.5, 0.1, True), (0.1, 0.1, False), (0.5, 0.0, False)])
def test_a_further_part_must_be_found_in_both_states_and_held(monkeypatch, confidence, evidence, taken):
    states, labels, views = two_states(slide())
    margins = [torch.ones(len(labels))] * 2
    motion = SimpleNamespace(confidence=confidence)
    monkeypatch.setattr(settle, "measure_joints", lambda *a, **o: [SimpleNamespace(confidence=evidence)] * 2)
    # once there is a second part, the moving panel is its
    monkeypatch.setattr(settle, "relabel", lambda found, transforms, types: SimpleNamespace(motions=[motion] * len(types)))
    monkeypatch.setattr(settle, "label_gaussians", lambda explanation, states: ([labels * len(explanation.motions)] * 2, margins))
    monkeypatch.setattr(settle, "instead_of", lambda found, transforms, types, part: [(slide(), "prismatic")] if part is None else [])
    wrong = PartMotions(["revolute"], hinge()[None], torch.ones(1), [labels, labels], margins)
    config = PartMotionsConfig(coarse=COARSE, split_reach=0.0)
    found, log = settle.reconsider(NO_SURFACES, states, wrong, views, config, [None, None], 2, seed=0, backend="auto")
    assert log[0]["after"] < 0.9 * log[0]["before"] and log[0]["confidence"] == pytest.approx(confidence)
    assert found.types == (["revolute", "prismatic"] if taken else ["revolute"]) and log[0]["evidence"] == evidence


def test_a_part_of_which_one_state_shows_nothing_is_dropped(monkeypatch):
    states, labels, views = two_states(slide())
    margins, told = [torch.ones(len(labels))] * 2, []

    def relabel(found, transforms, types):
        told.append(list(types))
        return SimpleNamespace(motions=[SimpleNamespace(confidence=0.5)] * len(types))

    monkeypatch.setattr(settle, "relabel", relabel)
    monkeypatch.setattr(settle, "label_gaussians", lambda *a: ([labels, labels], margins))
    config = PartMotionsConfig(coarse=COARSE, split_reach=0.0)
    options = {"seed": 0, "backend": "auto"}
    two = PartMotions(["revolute", "prismatic"], torch.stack([hinge(), slide()]), torch.tensor([0.01, 0.4]), [labels * 2] * 2, margins)
    kept, gone = settle.drop_unfounded(None, states, two, views, config, [None, None], **options)
    assert kept.types == ["prismatic"] and told == [["prismatic"]]
    assert gone == [{"type": "revolute", "confidence": pytest.approx(0.01)}]
    assert float((kept.transforms[0] - slide()).norm()) < 0.01
    same, gone = settle.drop_unfounded(None, states, kept, views, config, [None, None], **options)
    assert same is kept and gone == []
    none, gone = settle.drop_unfounded(None, states, two, views, PartMotionsConfig(min_confidence=0.0), [None, None], **options)
    assert none is two and gone == []


def _explained(*motions):
    """What ``find_part_motions`` knows of an explanation, labels aside."""
    transforms = torch.stack([T for _, T in motions]) if motions else torch.zeros(0, 4, 4).double()
    return PartMotions([kind for kind, _ in motions], transforms, torch.ones(len(motions)), [], [])


def test_what_is_nearly_as_good_and_says_something_else_goes_on():
    near = slide()
    near[:3, 3] += 0.01
    a, b, same = ("prismatic", slide()), ("revolute", hinge()), ("prismatic", near)
    config = PartMotionsConfig(contenders=2, contend=0.1)

    def numbers(*ranked, config=config):
        return [n for _, n, _ in _contenders([(rank, n, _explained(*m)) for n, (rank, m) in enumerate(ranked)], config)]

    assert numbers((1.05, [a]), (1.0, [b])) == [1, 0]
    assert numbers((1.0, [a]), (1.2, [b])) == [0]  # too much worse
    assert numbers((1.0, [a]), (1.02, [same]), (1.05, [a, b])) == [0, 2]  # the second says the same
    assert numbers((1.0, [a, b]), (1.0, [b, same])) == [0]  # in another order
    assert numbers((1.0, [a]), (1.01, [b]), (1.02, [])) == [0, 1]  # two at most
    assert numbers((1.0, [a]), (1.01, [b]), config=PartMotionsConfig(contenders=1)) == [0]
    assert numbers((1.0, [])) == [0]
    assert numbers((-2.5, [a]), (-2.45, [b]), (-2.0, [])) == [0, 1]  # energies are logarithms: below 0 as a rule


def test_halves_that_the_directions_tell_apart_differently_are_no_parts(monkeypatch):
    """However much of the image loss they save."""
    states, labels, views = two_states(slide())
    margins, sure = [torch.ones(len(labels))] * 2, SimpleNamespace(confidence=0.9)
    off = slide()
    off[:3, 3] += 0.02
    motions = PartMotions(["prismatic"], off[None], torch.ones(1), [labels, labels], margins)
    halves = PartMotions(["prismatic"] * 2, torch.stack([slide(), slide()]), torch.ones(2), [labels, labels], margins)
    monkeypatch.setattr(settle, "relabel", lambda found, transforms, types: SimpleNamespace(motions=[sure] * len(types)))
    monkeypatch.setattr(settle, "label_gaussians", lambda *a: ([labels, labels], margins))
    monkeypatch.setattr(settle, "instead_of", lambda *a: [])
    monkeypatch.setattr(settle, "splits", lambda *a, steps=None, **k: [(0, halves)] if steps else [])
    monkeypatch.setattr(settle, "_evidence", lambda *a: [sure] * 2)
    config = PartMotionsConfig(coarse=COARSE)
    for told, parts in ((0.1, 2), (0.9, 1)):
        monkeypatch.setattr(settle, "ways_disagree", lambda *a, told=told, **k: told)
        found, log = settle.reconsider(NO_SURFACES, states, motions, views, config, [None, None], 2, seed=0, backend="auto")
        assert len(found) == parts and any(entry.get("ways") == told for entry in log)
