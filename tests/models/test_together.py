"""Motions and Gaussians fitted together: a motion that is off is put right, a right one stays."""

import pytest
import torch
from test_finish import two_states
from tiny import hinge, photographs, slide

from p2gs.data.views import TrainingViews
from p2gs.gaussians.handover import PartMotions
from p2gs.models.together import fit_together
from p2gs.models.tune import TuneConfig
from p2gs.motion.light import brighter
from p2gs.ops import se3

LEVEL, SSIM = TuneConfig(steps=400, levels=[64]), 0.8
JOINTS = [("revolute", hinge()), ("prismatic", slide())]


def fitted(g, labels, views, kind, start, **options):
    motions = PartMotions([kind], start[None], torch.ones(1), [labels, labels], [torch.ones(len(labels))] * 2)
    return motions, *fit_together(g, labels, motions, 0.0, views, LEVEL, SSIM, seed=0, **options)


def off(found, truth, g, labels):
    points = g.means[labels == 1].double()
    return float((se3.apply(found, points) - se3.apply(truth, points)).norm(dim=1).mean())


@pytest.mark.parametrize("kind, truth", JOINTS)
def test_a_motion_that_is_off_is_put_right_and_keeps_its_type(kind, truth):
    states, labels, views = two_states(truth)
    g, wrong = states[0].gaussians, se3.screw_at(truth[None], 1.02)[0]
    _, found, loss = fitted(g, labels, views, kind, wrong)
    T = found.transforms[0]
    assert loss["free"] < loss["held"]
    assert off(T, truth, g, labels) < 0.3 * off(wrong, truth, g, labels)
    assert torch.equal(T[:3, :3], torch.eye(3).double()) if kind == "prismatic" else abs(
        se3.screw_parameters(T).translation
    ) < 1e-9  # fmt: skip


def test_a_part_that_is_brighter_in_the_end_is_put_right_too():
    truth = hinge()
    states, labels, _ = two_states(truth)
    g, wrong = states[0].gaussians, se3.screw_at(truth[None], 1.02)[0]
    lit = brighter(g, torch.tensor([1.0, 0.7])[labels])
    views = {
        s: TrainingViews(photographs(x, labels, T, s), [64])
        for s, (x, T) in enumerate([(g, torch.eye(4).double()), (lit, truth)])
    }
    _, found, _ = fitted(g, labels, views, "revolute", wrong)
    assert off(found.transforms[0], truth, g, labels) < 0.4 * off(wrong, truth, g, labels)


@pytest.mark.parametrize("kind, truth", JOINTS)
def test_a_right_motion_stays_where_it_is(kind, truth):
    states, labels, views = two_states(truth)
    g = states[0].gaussians
    _, found, _ = fitted(g, labels, views, kind, truth)
    assert off(found.transforms[0], truth, g, labels) < 1e-3


def test_an_axis_that_is_held_stays():
    truth = hinge()
    states, labels, views = two_states(truth)
    g, axis = states[0].gaussians, se3.screw_parameters(truth).axis
    _, found, _ = fitted(g, labels, views, "revolute", se3.screw_at(truth[None], 1.02)[0], axes=axis[None])
    torch.testing.assert_close(se3.screw_parameters(found.transforms[0]).axis, axis, atol=1e-9, rtol=0)
    assert off(found.transforms[0], truth, g, labels) < 1e-2


def test_without_steps_or_parts_nothing_is_fitted():
    states, labels, views = two_states(hinge())
    g = states[0].gaussians
    motions = PartMotions(["revolute"], hinge()[None], torch.ones(1), [labels] * 2, [torch.ones(len(labels))] * 2)
    none = PartMotions(
        [], torch.zeros(0, 4, 4).double(), torch.ones(0), [0 * labels] * 2, [torch.ones(len(labels))] * 2
    )
    assert fit_together(g, labels, motions, 0.0, views, TuneConfig(steps=0), SSIM, seed=0) == (motions, {})
    assert fit_together(g, 0 * labels, none, 0.0, views, LEVEL, SSIM, seed=0) == (none, {})
