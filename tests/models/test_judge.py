"""Explanations are compared on the same pixels."""

import math
from dataclasses import replace

import pytest
import torch
from test_finish import two_states
from tiny import hinge, photographs, slide, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.difference import weighted_loss
from p2gs.motion.joint_confidence import state_depth
from p2gs.motion.refine_motions import Judge, Latest, explanation_cost, what_counts
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3
from p2gs.ops.carry import Parts, carry
from p2gs.ops.ssim import l1_ssim_reference, ssim_map

CONFIG = PolishConfig(levels=[64], level_starts=[0.0], steps=0)


def panels():
    """A judge of two states, the motion between them, and one that carries the panel behind the static one."""
    states, labels, views = two_states(slide())
    stacks = [state_depth(s, views[s.state], 64) for s in states]
    behind = slide()
    behind[1, 3] -= 0.6
    motions = [
        PartMotions(["prismatic"], T[None], torch.ones(1), [labels, labels], [torch.ones(len(labels))] * 2)
        for T in (slide(), behind)
    ]
    return Judge(None, states, views, CONFIG, stacks, 0, "auto"), *motions


def test_what_was_asked_lately_is_not_worked_out_again():
    asked, latest = [], Latest(2)
    one, other = object(), object()

    def answer(of, also=None):
        return latest(of, lambda: asked.append((of, also)) or len(asked), also)

    assert [answer(one, "a"), answer(one, "a"), answer(one, "b"), answer(one, "a")] == [1, 1, 2, 1]
    assert [answer(other), answer(one, "a"), answer(one, "b")] == [3, 1, 4]  # the longest unasked one went


def test_refinement_and_a_glance_look_at_what_the_judge_saw(monkeypatch):
    judge, true, _ = panels()
    judge.config = replace(CONFIG, steps=2)
    looks = []
    monkeypatch.setattr(
        "p2gs.motion.refine_motions.what_counts", lambda *a, **o: looks.append(a[1]) or what_counts(*a, **o)
    )
    seen = judge.seen(true)
    assert judge.at_a_glance(1).seen(true) is seen
    refined = judge.refine(true)
    assert looks == [true]
    judge.gain(refined, true)
    assert looks == [true, refined]


def test_gain_is_of_the_pixels_of_both():
    judge, true, false = panels()
    told = 0.0
    for by in (true, false):
        seen = what_counts(judge.states, by, CONFIG, judge.stacks, backend="auto")
        options = {"by": seen, "backend": "auto"}
        cost = [explanation_cost(judge.states, m, judge.views, CONFIG, judge.stacks, **options) for m in (true, false)]
        told += 0.5 * math.log(cost[1] / cost[0])
    assert judge.gain(true, false) == pytest.approx(told, rel=1e-6) and told > 0.1
    assert judge.gain(false, true) == pytest.approx(-told, rel=1e-6) and judge.gain(true, true) == 0.0


def test_a_part_saves_as_much_in_its_own_pixels_however_small_it_is():
    """Of the panel that slides, a tenth alone; the rest stands in both explanations."""
    judge, true, _ = panels()
    still = replace(true, labels=[torch.zeros_like(of) for of in true.labels])
    edge = judge.states[0].gaussians.means[:, 0] > 0.25
    small = torch.where(edge, true.labels[0], 0)
    tenth = replace(true, labels=[small, small])
    whole, part = judge.own_share(true, still), judge.own_share(tenth, still)
    assert whole > 0.3 and part > 0.3
    assert judge.saved(tenth, still) < 0.3 * judge.saved(true, still)  # of all pixels it saves less
    assert judge.own_share(still, tenth) < 0 and judge.own_share(true, true) == 0.0


def test_weighted_loss_is_the_losses_mean_where_all_pixels_weigh_alike():
    g = torch.Generator().manual_seed(0)
    a, b = (torch.rand(24, 30, 3, generator=g) for _ in range(2))
    even = weighted_loss(a, b, torch.ones(24, 30), 0.8) / (24 * 30)
    assert float(even) == pytest.approx(float(l1_ssim_reference(a, b, 0.8)), rel=1e-5)
    spot = torch.zeros(24, 30)
    spot[7, 20] = 2.0
    one = 0.2 * (a - b)[7, 20].abs().mean() + 0.8 * (1 - ssim_map(a, b)[7, 20].mean())
    assert float(weighted_loss(a, b, spot, 0.8)) == pytest.approx(2 * float(one), rel=1e-4)
    assert float(weighted_loss(a, b, torch.zeros(24, 30), 0.8)) == 0.0


class Hiding(Judge):
    """Under ``false`` hardly a pixel counts, and those that do look the same under both."""

    def cost(self, motions, by=None):
        true = motions.transforms[0, 1, 3] == 0
        if by is None or by is motions:
            return 0.08 if true else 0.05
        return 0.051 if true else 0.20


def test_what_hides_its_own_pixels_does_not_win_by_that():
    judge, true, false = panels()
    judge = Hiding(None, judge.states, judge.views, CONFIG, judge.stacks, 0, "auto")
    assert judge(false)[0] < judge(true)[0]  # by the data that each chose
    assert judge.gain(true, false) > 0.4
    assert judge.no_worse(true, false).transforms[0].equal(true.transforms[0])
    assert judge.no_worse(false, true).transforms[0].equal(true.transforms[0])


def test_answers_are_the_same_bits_for_any_number_of_threads():
    answers = []
    for count in (1, 2):
        torch.set_num_threads(count)
        judge, true, false = panels()
        judge.config = replace(CONFIG, steps=4)
        refined = judge.refine(false)
        answers.append((judge.gain(true, false), judge.own_share(true, false), refined.transforms.tolist()))
        assert torch.get_num_threads() == count
    assert answers[0] == answers[1]


def test_a_part_that_was_explained_better_before_goes_back_alone():
    """Of two bodies one got better and one worse: each keeps the motion that explains it."""
    size, still = 96, torch.eye(4, dtype=torch.float64)
    # everything has a say: of these panels of thick blobs much reaches over its edge
    polish = PolishConfig(steps=100, levels=[size], level_starts=[0.0], min_margin=0.0, free_static=0.0)
    g, moving = textured_panels(1200)
    means, quats, sh = carry(g.means, g.quats, g.sh, Parts(moving), torch.stack([hinge()]))
    states = [StateGaussians(0, g), StateGaussians(1, replace(g, means=means, quats=quats, sh=sh))]
    views = {
        s: TrainingViews(photographs(x.gaussians, moving, still, 0, size, 8), [size], crop=False)
        for s, x in enumerate(states)
    }
    labels = torch.where((moving == 0) & (g.means[:, 0] < g.means[:, 0].mean()), 2, moving)
    margins = [torch.ones(len(labels))] * 2
    wrong = se3.exp(torch.tensor([0, 0, 0.05, 0.02, 0, 0], dtype=torch.float64))

    def bodies(first, second):
        return PartMotions(["free"] * 2, torch.stack([first, second]), torch.ones(2), [labels] * 2, margins)

    judge = Judge(None, states, views, polish, [state_depth(s, views[s.state], size) for s in states], 0, "auto")
    kept = judge.no_worse(bodies(wrong @ hinge(), still), bodies(hinge(), wrong)).transforms
    assert torch.equal(kept[0], hinge()) and torch.equal(kept[1], still)
