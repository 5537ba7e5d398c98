"""The last fit of the Gaussians: colours and surfaces follow the photographs, labels and motions stay."""

from dataclasses import dataclass

import torch
from test_finish import two_states
from tiny import hinge

from p2gs.gaussians.pose import carry, with_static
from p2gs.losses.base import LOSSES, Loss
from p2gs.models.tune import TuneConfig, tune
from p2gs.motion.screw_polish import photometric_cost
from p2gs.types import GaussianTensors

LEVEL = TuneConfig(steps=60, levels=[64])


def faded():
    """The two panels with colours half as strong as the photographs'; the photographs of both states."""
    states, labels, views = two_states(hinge())
    g = states[0].gaussians
    return GaussianTensors(g.means, g.quats, g.log_scales, g.opacity_logits, 0.5 * g.sh), labels, views


def cost(g, labels, views, state):
    """Image loss of the Gaussians (canonical time 0) in one state."""
    posed = carry(g, labels, with_static(hinge()[None])) if state else g
    return photometric_cost(posed, torch.zeros_like(labels), torch.zeros(0, 4, 4).double(), views[state], level=64)


def test_both_states_are_explained_better_and_the_same_every_time():
    g, labels, views = faded()
    losses = {"render": LOSSES["render"](), "part": LOSSES["part"]()}  # a loss of parts has no say and no data here
    tuned, again = (tune(g, labels, hinge()[None], 0.0, views, losses, LEVEL, seed=3) for _ in range(2))
    for state in (0, 1):
        assert cost(tuned, labels, views, state) < 0.7 * cost(g, labels, views, state)
    assert all(torch.equal(getattr(tuned, n), getattr(again, n)) for n in g.NAMES)
    assert len(tuned) == len(g) and not tuned.means.requires_grad


def test_under_a_wrong_motion_the_photographs_disagree():
    g, labels, views = faded()
    losses = {"render": LOSSES["render"]()}
    still = tune(g, labels, torch.eye(4).double()[None], 0.0, views, losses, LEVEL, seed=3)
    right = tune(g, labels, hinge()[None], 0.0, views, losses, LEVEL, seed=3)
    assert cost(right, labels, views, 0) < cost(still, labels, views, 0)


def test_a_picture_loss_of_ones_own_counts_and_need_not_be_due_in_every_step():
    class Squared(Loss):
        needs, kind = set(), "image"

        def compute(self, inputs):
            return (inputs.render.colour - inputs.target.image).square().mean()

    g, labels, views = faded()
    tuned = tune(g, labels, hinge()[None], 0.0, views, {"mine": dataclass(Squared)(every=2)}, LEVEL, seed=3)
    assert cost(tuned, labels, views, 0) < 0.9 * cost(g, labels, views, 0)


def test_off_and_without_a_picture_loss_nothing_changes():
    g, labels, views = faded()
    assert tune(g, labels, hinge()[None], 0.0, views, {}, LEVEL, seed=0) is g
    assert tune(g, labels, hinge()[None], 0.0, views, {"render": LOSSES["render"]()}, TuneConfig(steps=0), seed=0) is g
