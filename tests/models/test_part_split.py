"""Two parts of nearly one motion, taken for one: the photographs tell them apart."""

from dataclasses import replace

import pytest
import torch
from tiny import hinge, photographs, slide, textured_panels

from p2gs.data.views import TrainingViews
from p2gs.models.discovery.evidence import DepthStack
from p2gs.models.evidence import render_depths
from p2gs.models.handover import PartMotions, StateGaussians
from p2gs.models.part_split import FINE, amount_costs, residuals_by_gaussian, rim, splits, ways_disagree, with_amount
from p2gs.models.screw_polish import MovedGaussians, PolishConfig
from p2gs.ops import se3
from p2gs.types import GaussianTensors

OPTIONS = {"level": 64, "backend": "auto"}


def two_halves(kind: str, apart: float):
    """The moving panel is two, left (1) and right (2), whose displacements differ by ``apart``; and the motions that take them for one."""
    g, labels = textured_panels()
    labels = labels + ((labels == 1) & (g.means[:, 0] > 0)).long()
    T = slide() if kind == "prismatic" else hinge()
    arm = 1.0 if kind == "prismatic" else 0.4
    both = torch.stack([with_amount(T, kind, sign * apart / 2, arm) for sign in (-1, 1)])
    means, quats, sh = MovedGaussians(g, labels).moved(both)
    states = [StateGaussians(0, g), StateGaussians(1, GaussianTensors(means, quats, g.log_scales, g.opacity_logits, sh))]
    still = torch.eye(4).double().repeat(2, 1, 1)
    views = {s: TrainingViews(photographs(g, labels, M, s), [64]) for s, M in ((0, still), (1, both))}
    one = labels.clamp_max(1)
    return states, PartMotions([kind], T[None], torch.ones(1), [one, one], [torch.ones(len(one))] * 2), views, labels


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_two_parts_that_were_taken_for_one_are_told_apart(kind):
    states, one, views, labels = two_halves(kind, 0.06)
    found = splits(states, one, views, 0.05, 0.12, **OPTIONS)
    assert [part for part, _ in found] == [0]
    two = found[0][1]
    assert two.types == [kind] * 2 and len(two.confidence) == 2
    for state in (0, 1):
        assert torch.equal(two.labels[state] == 0, labels == 0)
        same = float((two.labels[state] == labels)[labels > 0].float().mean())
        assert max(same, 1 - same) > 0.9
    moved = [se3.apply(T, torch.tensor([[0.0, 0.5, 0.0]]).double())[0] for T in two.transforms]
    assert float((moved[0] - moved[1]).norm()) == pytest.approx(0.06, abs=0.03)


def test_one_part_stays_one():
    states, one, views, _ = two_halves("prismatic", 0.0)
    assert splits(states, one, views, 0.05, 0.12, **OPTIONS) == []
    assert splits(states, one, views, 0.0, 0.12, **OPTIONS) == []


def test_residuals_are_those_of_the_pixels_a_gaussian_shows_in():
    states, one, views, labels = two_halves("prismatic", 0.06)
    apart, shows = residuals_by_gaussian(states[0].gaussians, one.labels[0], one.transforms, views[1], count=8, **OPTIONS)
    right, _ = residuals_by_gaussian(states[0].gaussians, 0 * labels, one.transforms, views[0], count=8, **OPTIONS)
    left_out = torch.where(labels == 2, -1, one.labels[0])
    _, fewer = residuals_by_gaussian(states[0].gaussians, left_out, one.transforms, views[1], count=8, **OPTIONS)
    seen = shows > 1
    assert 2 * float(right[seen].mean()) < float(apart[seen & (labels > 0)].mean())
    assert float(fewer[labels == 2].abs().sum()) == 0 < float(fewer[labels == 1].sum())


def test_an_amount_more_is_that_displacement_at_the_rim():
    states, one, views, _ = two_halves("revolute", 0.0)
    arm = rim(states, one, 0)
    axis = se3.screw_parameters(one.transforms[0])
    at = axis.origin + arm * torch.nn.functional.normalize(torch.linalg.cross(axis.axis, torch.tensor([1.0, 0, 0]).double()), dim=0)
    gap = se3.apply(with_amount(one.transforms[0], "revolute", 0.02, arm), at[None]) - se3.apply(one.transforms[0], at[None])
    assert float(gap.norm()) == pytest.approx(0.02, rel=1e-3)
    costs = amount_costs(states, one, views, [-0.02, 0.0, 0.02], **OPTIONS)
    assert costs[0][0].shape == costs[1][1].shape == (600, 3)
    moving = one.labels[0] == 1
    assert int((costs[0][0] * costs[0][1])[moving].sum(0).argmin()) == 1


def test_a_small_difference_is_found_by_fine_steps_and_told_alike_by_both_directions():
    states, one, views, labels = two_halves("prismatic", 0.024)
    found = splits(states, one, views, 0.05, 0.03, steps=FINE, **OPTIONS)
    assert [part for part, _ in found] == [0]
    assert ways(states, found[0][1], views) < 0.27


def test_a_surface_that_errs_in_one_state_is_no_second_motion():
    """One part, but half of it lies off in the start's reconstruction: only start -> end takes it for a motion of its own."""
    states, one, views, labels = two_halves("prismatic", 0.0)
    off = states[0].gaussians.clone()
    off.means[labels == 2] += torch.tensor([0.024, 0.0, 0.0])
    states[0] = StateGaussians(0, off)
    two = one.with_motion(1, "prismatic", with_amount(one.transforms[0], "prismatic", 0.01, 1.0))
    two = replace(two, labels=[labels, labels], confidence=torch.ones(2))
    assert ways(states, two, views) > 0.5


def ways(states, motions, views) -> float:
    cameras = [views[0].camera(i, 0) for i in range(len(views[0]))]
    config = PolishConfig(steps=60, levels=[64], level_starts=[0.0], rate=5e-3, min_margin=0.0, free_static=0.0, front=-1.0)
    stacks = [DepthStack(*render_depths(s.gaussians, cameras, "auto", "cpu"), cameras) for s in states]
    return ways_disagree(states, motions, (0, 1), views, config, stacks, seed=0, backend="auto")
