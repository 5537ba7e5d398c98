"""Labels, slots and joints at the end; parts that are one become one."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from tiny import hinge, photographs, slide, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import Articulation, PartMotions, StateGaussians
from p2gs.models.finish import FinishConfig, finish
from p2gs.models.joint_of import constrain, make_joint, name_types
from p2gs.models.tune import TuneConfig
from p2gs.models.twin_labels import (
    clean_labels,
    majority,
    only,
    rows_as_found,
    state_labels,
    surviving_slots,
    with_mass,
)
from p2gs.motion.joint_confidence import state_depth
from p2gs.motion.refine_motions import Judge
from p2gs.motion.screw_polish import MovedGaussians, PolishConfig
from p2gs.ops import se3
from p2gs.parts.part_choices import better, drop_needless, drop_untold, needless, simplify, without_part
from p2gs.types import GaussianTensors, Similarity


def two_states(transform):
    g, labels = textured_panels()
    means, quats, sh = MovedGaussians(g, labels).moved(transform[None])
    states = [
        StateGaussians(0, g),
        StateGaussians(1, GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh)),
    ]
    views = {
        s: TrainingViews(photographs(g, labels, T, s), [64]) for s, T in ((0, torch.eye(4).double()), (1, transform))
    }
    return states, labels, views


def test_majority_counts_weights():
    labels = torch.tensor([0, 1, 1])
    label, share = majority(labels, torch.tensor([[0, 1, 2]]), torch.tensor([[3.0, 1.0, 1.0]]), 2)
    assert label.item() == 0 and abs(share.item() - 0.6) < 1e-6


def test_clean_labels_mends_a_lone_flip():
    g, labels = textured_panels()
    flipped = labels.clone()
    flipped[7] = 1 - flipped[7]
    assert torch.equal(clean_labels(g, flipped, 2, 8), labels)
    assert torch.equal(clean_labels(g, flipped, 2, 0), flipped)


@pytest.mark.parametrize("own, further_axis, wins", [(0.2, True, True), (0.1, True, False), (0.1, False, True)])
def test_an_explanation_with_a_further_axis_must_save_in_its_own_pixels(own, further_axis, wins):
    """Two doors and a scrap that turns about a line of its own: of the whole energy it saves a ten-thousandth."""
    none = torch.zeros(0)
    second = slide() @ slide() if not further_axis else hinge()
    one = PartMotions(["prismatic"], slide()[None], torch.ones(1), [none] * 2, [none] * 2)
    kinds = ["prismatic", "revolute" if further_axis else "prismatic"]
    two = PartMotions(kinds, torch.stack([slide(), second]), torch.ones(2), [none] * 2, [none] * 2)
    judge = SimpleNamespace(
        further=0.15,
        gain=lambda tried, than: 1e-4 * (len(tried) - len(than)),
        own_share=lambda tried, than: own * (len(tried) - len(than)),
    )
    assert better(judge, two, one) is wins and better(judge, one, two) is not wins
    assert not better(judge, one, one)


@pytest.mark.parametrize("second, kinds, mended", [(0.206, "ss", True), (0.3, "ss", False), (0.206, "rs", False)])
def test_the_border_of_drawers_that_went_nearly_alike_stays_where_it_was_found(second, kinds, mended):
    """Two drawers side by side, a few Gaussians of which were learned for the other's."""
    points = torch.cartesian_prod(torch.linspace(0, 1, 20), torch.linspace(0, 0.4, 8), torch.zeros(1)).float()
    n, found = len(points), 1 + (points[:, 0] > 0.5).long()
    quats, scales = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), torch.full((n, 3), -4.0)
    g = GaussianTensors(points, quats, scales, torch.full((n,), 4.0), torch.zeros(n, 1, 3))
    T = torch.eye(4).double().repeat(2, 1, 1)
    T[:, 2, 3] = torch.tensor([0.2, second])
    types = ["prismatic" if k == "s" else "revolute" for k in kinds]
    end = points + T[found - 1][:, :3, 3].float()
    states = [StateGaussians(0, g), StateGaussians(1, g.placed(end, quats))]
    discovered = PartMotions(types, T, torch.ones(2), [found, found], [torch.ones(n)] * 2)
    labels = torch.where(torch.arange(n) % 7 == 0, 3 - found, found)
    learned = Articulation(g, torch.eye(3)[labels], types, T, torch.ones(2), 0.0)
    kept = rows_as_found(learned, labels, states, discovered, 0.02)
    assert torch.equal(kept, found if mended else labels)
    assert torch.equal(rows_as_found(learned, labels, states, discovered, 0.0), labels)


def test_a_state_takes_the_twins_labels_but_for_what_the_twin_does_not_have():
    states, labels, _ = two_states(hinge())
    learned = Articulation(states[0].gaussians, torch.eye(2)[labels], ["revolute"], hinge()[None], torch.ones(1), 0.0)
    g = states[1].gaussians
    lid = g[:20].placed(g.means[:20] + torch.tensor([0.0, 0, 5]), g.quats[:20])  # a state's own, nowhere near the twin
    label, margin = state_labels(learned, labels, StateGaussians(1, GaussianTensors.cat([g, lid])), learned.transforms)
    assert (margin[-20:] == -1).all() and (margin[:-20] >= 0).float().mean() > 0.99
    assert (label[:-20] == labels).float().mean() > 0.9


def test_joints_say_what_their_transform_does():
    centre = torch.tensor([0.1, 0.2, 0.3]).double()
    turn, push = make_joint("revolute", hinge(), centre), make_joint("prismatic", slide(), centre)
    rebuilt = se3.from_screw(turn.axis, turn.origin, turn.motion / 57.29577951308232)
    assert torch.allclose(rebuilt, hinge(), atol=1e-9)
    assert torch.allclose(push.axis * push.motion, slide()[:3, 3]) and push.limits == (0.0, push.motion)
    assert torch.equal(push.origin, centre)


def test_free_motions_get_a_type():
    small = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.zeros(3).double(), 0.02)
    assert name_types(["free", "free", "prismatic"], torch.stack([small, hinge(), hinge()]), 5.0) == [
        "prismatic",
        "revolute",
        "prismatic",
    ]
    assert torch.equal(constrain("prismatic", small, torch.zeros(3).double())[:3, :3], torch.eye(3).double())


def test_without_part_renumbers():
    T = torch.stack([torch.eye(4).double() * k for k in (1, 2, 3)])
    motions = PartMotions(
        ["a", "b", "c"], T, torch.tensor([0.1, 0.2, 0.3]), [torch.tensor([0, 1, 2, 3])] * 2, [torch.ones(4)] * 2
    )
    merged = without_part(motions, 1, 3)
    assert merged.types == ["a", "c"] and merged.labels[0].tolist() == [0, 1, 2, 2] and merged.transforms[1, 0, 0] == 3
    assert without_part(motions, 0, 0).labels[0].tolist() == [0, 0, 1, 2]


def test_one_part_cut_in_two_becomes_one_and_a_true_part_stays(monkeypatch):
    states, labels, views = two_states(hinge())
    cut = torch.where((labels == 1) & (states[0].gaussians.means[:, 2] > 0.1), 2, labels)
    near = se3.from_screw(torch.tensor([0.0, 0.1, 1]).double(), torch.tensor([0.4, 0.5, 0]).double(), 0.51)
    motions = PartMotions(
        ["revolute"] * 2, torch.stack([hinge(), near]), torch.ones(2), [cut, cut], [torch.ones(len(cut))] * 2
    )
    stacks = [state_depth(s, views[s.state], 64) for s in states]
    judge = Judge(
        SimpleNamespace(search=None), states, views, PolishConfig(levels=[64], level_starts=[0.0]), stacks, 0, "auto"
    )
    # the price of parts alone
    monkeypatch.setattr("p2gs.motion.refine_motions.surface_energy", lambda found, T, types: 0.03 * len(types))
    simple = simplify(judge, motions, 0.04)
    assert len(simple) == 1 and torch.equal(simple.labels[0], labels)
    # the start hides one of the pieces: that they touch shows in the end
    half = PartMotions(
        ["revolute"] * 2, torch.stack([hinge(), near]), torch.ones(2), [labels, cut], [torch.ones(len(cut))] * 2
    )
    simple = simplify(judge, half, 0.04)
    assert len(simple) == 1 and torch.equal(simple.labels[1], labels)


@dataclass
class Told:
    """A judge that is told the image loss of one part in place of two; with what moves left to stand it is nine."""

    states: list
    moving: torch.Tensor
    one: float
    config: PolishConfig
    further: float = 0.0

    def __call__(self, motions):
        stands = bool((motions.labels[0][self.moving] == 0).any())
        cost = 9.0 if stands else (self.one if len(motions) == 1 else 1.0)
        return math.log(cost), cost

    def saved(self, tried, than):
        return self(than)[0] - self(tried)[0]

    gain = saved

    def own_share(self, tried, than):
        return 1 - self(tried)[1] / self(than)[1]

    def improved(self, motions):
        return (*self(motions), motions)


def halved(kind: str, first: torch.Tensor, second: torch.Tensor):
    """Both states of a part that moves by ``first``, its labels, those of its halves, and the halves as two parts."""
    states, labels, _ = two_states(first)
    cut = torch.where((labels == 1) & (states[0].gaussians.means[:, 2] > 0.1), 2, labels)
    margins = [torch.ones(len(cut))] * 2
    return (
        states,
        labels,
        cut,
        PartMotions([kind] * 2, torch.stack([first, second]), torch.ones(2), [cut, cut], margins),
    )


@pytest.mark.parametrize(("one", "left"), [(1.019, 1), (1.022, 2), (0.99, 1)])
def test_a_part_that_saves_less_than_a_part_must_becomes_its_neighbours(one, left):
    """A piece of a door that moves a little unlike the rest of it; a part must save a fiftieth."""
    other = se3.from_screw(torch.tensor([0.0, 0.2, 1]).double(), torch.tensor([0.4, 0.5, 0]).double(), 0.6)
    states, labels, cut, motions = halved("revolute", hinge(), other)
    judge = Told(states, cut > 0, one, PolishConfig())
    kept, relabelled, gone = drop_needless(judge, motions, cut, 0.02)
    assert len(kept) == left and torch.equal(relabelled, labels if left == 1 else cut)
    assert len(gone) == 2 - left and all("revolute" in part["why"] for part in gone)
    assert len(drop_needless(judge, motions, cut, 0.0)[0]) == 2  # switched off


@pytest.mark.parametrize(("one", "left"), [(1.005, 2), (0.99, 1)])
def test_of_two_turns_about_one_line_one_goes_if_photographs_do_not_need_it(one, left):
    """Two doors above one another must save less than doors on lines of their own, but something."""
    screw = se3.screw_parameters(hinge())
    further = se3.from_screw(screw.axis, screw.origin, 1.1 * float(screw.angle))
    states, _, cut, two = halved("revolute", hinge(), further)
    assert len(drop_needless(Told(states, cut > 0, one, PolishConfig()), two, cut, 0.02)[0]) == left


def test_needless_is_what_saves_less_than_its_axis_asks_for():
    """Of two turns about one line each must save something, of a turn and a slide each its 15 %, of slides along one
    way nothing, and of the only part nothing is asked."""
    states, _, _, turns = halved("revolute", hinge(), hinge())
    assert needless(states, turns, [0.01, -0.01], 0.15) == [1] and needless(states, turns, [0.01, None], 0.15) == []
    mixed = replace(turns, types=["revolute", "prismatic"], transforms=torch.stack([hinge(), slide()]))
    assert needless(states, mixed, [0.2, 0.1], 0.15) == [1] and needless(states, mixed, [0.1, 0.1], 0.0) == []
    slides = replace(turns, types=["prismatic"] * 2, transforms=torch.stack([slide(), slide()]))
    assert needless(states, slides, [-0.5, -0.5], 0.15) == []
    assert needless(states, without_part(turns, 1, 1), [-0.5], 0.15) == []


def test_the_part_that_photographs_tell_least_of_goes():
    states, _, cut, motions = halved("revolute", hinge(), hinge())
    judge = Told(states, cut > 0, 1.0, PolishConfig())
    assert drop_untold(judge, motions, cut, [0.5, 0.02], 0.02) == (motions, cut, [])
    alone, only = without_part(motions, 1, 1), cut.clamp_max(1)
    assert drop_untold(judge, alone, only, [0.01], 0.02) == (alone, only, [])  # something moved
    kept, relabelled, (gone,) = drop_untold(judge, motions, cut, [0.5, 0.01], 0.02)
    assert len(kept) == 1 and gone["part"] == 1 and "0.01" in gone["why"]
    assert torch.equal(relabelled, torch.where(cut == 2, 0, cut)) and torch.equal(kept.labels[0], relabelled)


def test_empty_and_unmoving_slots_vanish_with_a_word():
    states, labels, views = two_states(slide())
    idle = torch.eye(4).double()
    idle[0, 3] = 0.001
    probs = torch.nn.functional.one_hot(labels, 4).float()
    probs[:20] = torch.tensor([0.0, 0, 1, 0])  # a slot that does not move; the last slot is empty
    learned = Articulation(
        states[0].gaussians, probs, ["prismatic"] * 3, torch.stack([slide(), idle, slide()]), torch.ones(3), 0.0
    )
    config = FinishConfig(polish=PolishConfig(steps=0), clean_neighbours=0)
    assert surviving_slots(learned, learned.part_ids, config.min_mass, config.min_motion) == [1]
    twin, notes, _ = finish(learned, states, views, config, Similarity(), seed=0, backend="auto")
    assert len(twin.parts) == 2 and len(notes) == 2 and "slot 2 of 3 vanished" in notes[0]
    assert twin.parts[1].joint.type == "prismatic" and int(twin.part_ids.max()) == 1
    seen = twin.parts[1].joint.limits
    further = (
        finish(learned, states, views, replace(config, extend_range=True), Similarity(), seed=0, backend="auto")[0]
        .parts[1]
        .joint
    )
    assert seen == (0.0, further.motion) and further.limits[0] <= 0.0 and further.limits[1] > seen[1]


def test_a_part_that_settling_leaves_next_to_nothing_is_the_bases():
    g = GaussianTensors(
        torch.zeros(1000, 3),
        torch.ones(1000, 4),
        torch.zeros(1000, 3),
        torch.full((1000,), 3.0),
        torch.zeros(1000, 1, 3),
    )
    labels = torch.zeros(1000, dtype=torch.int64)
    labels[:400], labels[400], labels[500:600] = 1, 2, 3
    stay = with_mass(g, labels, 3, 0.002)
    settled = only(labels, stay, 3)
    assert stay == [1, 3] and torch.bincount(settled).tolist() == [500, 400, 100]
    assert with_mass(g, labels, 3, 0.001) == [1, 2, 3] == with_mass(g, labels, 3, 0.0)
    assert torch.equal(only(labels, [1, 2, 3], 3), labels)


def test_a_drawer_of_a_row_stays_though_photographs_hardly_need_it():
    """Its front is shut and plain; that it goes the row's way is no accident."""
    further = slide()
    further[:3, 3] *= 1.3
    states, _, cut, row = halved("prismatic", slide(), further)
    assert len(drop_needless(Told(states, cut > 0, 0.99, PolishConfig()), row, cut, 0.02)[0]) == 2
    askew = further.clone()
    askew[:3, 3] += torch.linalg.norm(further[:3, 3]) * 0.05 * torch.tensor([0.0, 0.0, 1.0])
    two = replace(row, transforms=torch.stack([slide(), askew]))
    assert len(drop_needless(Told(states, cut > 0, 0.99, PolishConfig()), two, cut, 0.02)[0]) == 1


@pytest.mark.parametrize("true", ["prismatic", "revolute"])
def test_a_turn_that_is_a_slide_to_the_photographs_is_one(true):
    """A slide learned as a turn of two degrees about an axis nine away; a turn of half a radian stays one."""
    way = slide()
    axis = torch.linalg.cross(way[:3, 3], torch.tensor([0.0, 1.0, 0.0]).double())
    axis = axis / axis.norm()
    away = torch.linalg.cross(axis, way[:3, 3]) / math.radians(2)
    states, labels, views = two_states(way if true == "prismatic" else hinge())
    middle = states[0].gaussians.means[labels == 1].double().mean(0)
    nearly = se3.from_screw(axis, middle + 0.5 * way[:3, 3] + away, math.radians(2))
    T = nearly if true == "prismatic" else hinge()
    assert float((se3.apply(nearly, middle[None])[0] - middle - way[:3, 3]).norm()) < 1e-3
    learned = Articulation(
        states[0].gaussians, torch.nn.functional.one_hot(labels, 2).float(), ["revolute"], T[None], torch.ones(1), 0.0
    )
    config = FinishConfig(
        polish=PolishConfig(steps=20, levels=[64], level_starts=[0.0]),
        clean_neighbours=0,
        survey=[],
        askew=0.0,
        together=TuneConfig(steps=20, levels=[64]),
    )
    twin, _, _ = finish(learned, states, views, config, Similarity(), seed=0, backend="auto")
    assert twin.parts[1].joint.type == true
    if true == "prismatic":
        assert twin.parts[1].joint.motion == pytest.approx(float(way[:3, 3].norm()), abs=5e-3)
