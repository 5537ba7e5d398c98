"""Explanations are compared on the same pixels."""

import math

import pytest
import torch
from test_finish import two_states
from tiny import slide

from p2gs.gaussians.handover import PartMotions
from p2gs.motion.joint_confidence import state_depth
from p2gs.motion.refine_motions import Judge, explanation_cost, what_counts
from p2gs.motion.screw_polish import PolishConfig

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


def test_gain_is_of_the_pixels_of_both():
    judge, true, false = panels()
    told = 0.0
    for by in (true, false):
        seen = what_counts(judge.states, by, CONFIG, judge.stacks, backend="auto")
        options = {"seen": seen, "backend": "auto"}
        cost = [explanation_cost(judge.states, m, judge.views, CONFIG, judge.stacks, **options) for m in (true, false)]
        told += 0.5 * math.log(cost[1] / cost[0])
    assert judge.gain(true, false) == pytest.approx(told, rel=1e-6) and told > 0.1
    assert judge.gain(false, true) == pytest.approx(-told, rel=1e-6) and judge.gain(true, true) == 0.0


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
