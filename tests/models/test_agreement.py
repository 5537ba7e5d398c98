"""What both states show has a say in where a part went; what one state hides has none."""

import pytest
import torch
from tiny import look_at

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.agreement import ShownPixels, ends, kept_and_shown
from p2gs.motion.screw_polish import PolishConfig
from p2gs.types import GaussianTensors
from p2gs.visibility.depth_stack import DepthStack

CONFIG = PolishConfig()


def splats(means, colour=0.0, scales=None):
    """Opaque splats [N, 3], flat along x; colour: of the constant SH, one number or one per splat."""
    n = len(means)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    scales = torch.tensor([0.001, 0.01, 0.01]).repeat(n, 1) if scales is None else scales
    sh = torch.as_tensor(colour, dtype=torch.float32).expand(n)[:, None, None].expand(n, 1, 3).clone()
    return GaussianTensors(means, quats, scales.log(), torch.full((n,), 4.0), sh)


def facing(x: float, side: float = 1.0, size: int = 32) -> DepthStack:
    """Six views along x, from ``side`` times 3, of the plane at x: nothing but this surface."""
    camera = look_at(torch.tensor([3.0 * side, 0.0, 0.0]), size)
    return DepthStack([torch.full((size, size), 3.0 - x * side)] * 6, [torch.ones(size, size)] * 6, [camera] * 6)


def asked(start: GaussianTensors, labels, end: GaussianTensors, end_labels, end_stack: DepthStack, way: float = 0.5):
    """What becomes of the start's splats that slide by ``way`` along x."""
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, 0, 3] = way
    motions = PartMotions(
        ["prismatic"], T, torch.ones(1), [labels, end_labels], [torch.ones(len(labels)), torch.ones(len(end_labels))]
    )
    states = [StateGaussians(0, start), StateGaussians(1, end)]
    return kept_and_shown(states, motions, 0, start, [facing(0.0), end_stack], CONFIG)


def grid(x: float, half: float = 0.3, n: int = 13) -> torch.Tensor:
    side = torch.linspace(-half, half, n)
    return torch.cat([torch.full((n * n, 1), x), torch.cartesian_prod(side, side)], 1)


def test_what_arrives_on_its_own_surface_is_shown():
    one, there = torch.ones(169, dtype=torch.long), splats(grid(0.5))
    kept, shown = asked(splats(grid(0.0)), one, there, one, facing(0.5))
    assert kept.all() and shown.all()


@pytest.mark.parametrize("why", ["another part's", "another colour", "seen through"])
def test_what_arrives_on_another_surface_or_in_the_air_has_no_say(why):
    one = torch.ones(169, dtype=torch.long)
    end_labels = torch.zeros_like(one) if why == "another part's" else one
    there = splats(grid(0.5), colour=1.5 if why == "another colour" else 0.0)
    stack = facing(0.3 if why == "seen through" else 0.5)
    kept, shown = asked(splats(grid(0.0)), one, there, end_labels, stack)
    assert not kept.any() and not shown.any()


@pytest.mark.parametrize("other, agrees", [(0.5, True), (0.502, True), (0.7, False)])
def test_two_parts_that_went_alike_agree_with_one_another(other, agrees):
    """Two drawers: the end's surface is labelled the second's, which slid by ``other``, the start's the first's."""
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[:, 0, 3] = torch.tensor([0.5, other])
    one = torch.ones(169, dtype=torch.long)
    start, end = splats(grid(0.0)), splats(grid(0.5))
    motions = PartMotions(["prismatic"] * 2, T, torch.ones(2), [one, 2 * one], [torch.ones(169)] * 2)
    states, stacks = [StateGaussians(0, start), StateGaussians(1, end)], [facing(0.0), facing(0.5)]
    kept, shown = kept_and_shown(states, motions, 0, start, stacks, CONFIG)
    assert bool(kept.all()) == agrees and bool(shown.any()) == agrees


@pytest.mark.parametrize("colour", [0.0, 1.5])
def test_a_thin_plates_other_side_hides_and_contradicts_nothing(colour):
    one, there = torch.ones(169, dtype=torch.long), splats(grid(0.5), colour=colour)
    kept, shown = asked(splats(grid(0.0)), one, there, one, facing(0.5, side=-1.0))
    assert kept.all() and not shown.any()
    kept, _ = asked(splats(grid(0.0)), one, there, torch.zeros_like(one), facing(0.5, side=-1.0))
    assert not kept.any()  # it is another part's side


def test_what_arrives_out_of_sight_is_kept_but_not_shown():
    one = torch.ones(169, dtype=torch.long)
    kept, shown = asked(splats(grid(0.0)), one, splats(grid(0.8)), one, facing(0.8))
    assert kept.all() and not shown.any()


def test_a_splat_that_reaches_into_seen_through_space_has_no_say():
    points, one = grid(0.0), torch.ones(169, dtype=torch.long)
    scales = torch.tensor([0.001, 0.01, 0.01]).repeat(169, 1)
    scales[0, 0] = 0.1  # a needle that sticks out by three tenths towards the cameras
    kept, _ = asked(splats(points, scales=scales), one, splats(grid(0.5)), one, facing(0.5))
    assert not kept[0] and kept[1:].all()


def test_ends_lie_three_deviations_along_the_two_long_axes():
    g = splats(torch.zeros(1, 3), scales=torch.tensor([[0.1, 0.2, 0.01]]))
    found = {tuple(x) for x in torch.cat(ends(g)).mul(10).round().int().tolist()}
    assert found == {(3, 0, 0), (-3, 0, 0), (0, 6, 0), (0, -6, 0)}


def test_pixels_of_hidden_surface_do_not_count_and_background_does():
    g = splats(grid(0.0))
    left = g.means[:, 1] < -0.01
    weight = ShownPixels(StateGaussians(0, g), ~left, "auto")(0, 0, look_at(torch.tensor([3.0, 0.0, 0.0]), 64))
    assert float(weight[:, :4].min()) == 1.0 and float(weight.min()) < 0.05  # beside it; on its hidden half
    assert 0.3 < float((weight > 0.9).float().mean()) < 0.98
