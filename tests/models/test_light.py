"""Light changes as a part turns; colours of two states are compared after a gain per turning part."""

import math
from dataclasses import replace

import pytest
import torch
from test_agreement import facing as seen_along_x
from test_agreement import grid, splats

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.agreement import kept_and_shown
from p2gs.motion.light import FEWEST, as_lit_there, brighter, facing, turning_gains
from p2gs.motion.screw_polish import PolishConfig
from p2gs.ops import se3
from p2gs.ops.sh import dc_to_rgb, evaluate
from p2gs.types import GaussianTensors

CONFIG = PolishConfig()
TURN = se3.from_screw(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([0.0, -0.4, 0.0]).double(), 1.0)


def plates(factor: float, n: int = 200):
    """A plate at the start and turned, ``factor`` times as bright, at the end: points, normals, colours, labels."""
    g = torch.Generator().manual_seed(0)
    at = torch.rand(n, 3, generator=g) * torch.tensor([0.0, 0.6, 0.6]) - torch.tensor([0.0, 0.3, 0.3])
    way, colour = torch.tensor([1.0, 0.0, 0.0]).expand(n, 3), 0.2 + 0.3 * torch.rand(n, 3, generator=g)
    turned = se3.apply(TURN.float(), at), way @ TURN[:3, :3].T.float()
    return [[at, turned[0]], [way, turned[1]], [colour, factor * colour], [torch.ones(n, dtype=torch.long)] * 2]


@pytest.mark.parametrize("factor", [0.6, 1.7])
def test_the_gain_is_how_much_brighter_the_end_is(factor):
    gain = turning_gains(*plates(factor), TURN[None], [True], 0.05)
    assert float(gain) == pytest.approx(factor, rel=1e-4)
    back = turning_gains(*[x[::-1] for x in plates(factor)], se3.inverse(TURN)[None], [True], 0.05)
    assert float(back) == pytest.approx(1 / factor, rel=1e-4)  # states exchanged


def test_slides_other_sides_and_few_points_have_no_gain():
    seen = plates(0.6)
    assert float(turning_gains(*seen, TURN[None], [False], 0.05)) == 1.0
    turned_over = [seen[0], [seen[1][0], -seen[1][1]], *seen[2:]]
    assert float(turning_gains(*turned_over, TURN[None], [True], 0.05)) == 1.0
    few = [[x[: FEWEST // 2 - 1] for x in both] for both in seen]
    assert float(turning_gains(*few, TURN[None], [True], 0.05)) == 1.0
    apart = [[seen[0][0], seen[0][1] + 1.0], *seen[1:]]
    assert float(turning_gains(*apart, TURN[None], [True], 0.05)) == 1.0


def test_brighter_multiplies_the_colour_from_every_direction():
    gen = torch.Generator().manual_seed(1)
    g = splats(torch.randn(5, 3, generator=gen))
    g = replace(g, sh=0.3 * torch.randn(5, 4, 3, generator=gen))
    labels, gains = torch.tensor([0, 1, 2, 1, -1]), torch.tensor([0.5, 2.0])
    way = torch.nn.functional.normalize(torch.randn(5, 3, generator=gen), dim=1)
    before, after = (evaluate(x.sh, way) for x in (g, brighter(g, labels, gains)))
    assert torch.allclose(after, before * torch.tensor([1.0, 0.5, 2.0, 0.5, 1.0])[:, None], atol=1e-6)


def test_gaussians_face_those_who_see_them():
    g = splats(grid(0.0))
    for side in (1.0, -1.0):
        normal = facing(g, seen_along_x(0.0, side), CONFIG.free_static)
        assert torch.allclose(normal, torch.tensor([side, 0.0, 0.0]).expand(len(g), 3))
    assert not facing(g, seen_along_x(0.5), CONFIG.free_static).any()  # hidden behind another plane


def turned_by(angle: float, colour: float) -> tuple[list[StateGaussians], PartMotions]:
    """A dark plate that turns about its own normal, so that views along x see it in both states, and then has
    ``colour`` (constant SH)."""
    T = se3.from_screw(torch.tensor([1.0, 0.0, 0.0]).double(), torch.zeros(3).double(), angle)
    start, end = splats(grid(0.0), -1.0), splats(se3.apply(T.float(), grid(0.0)), colour)
    one = torch.ones(len(start), dtype=torch.long)
    motions = PartMotions(["revolute"], T[None], torch.ones(1), [one, one], [torch.ones(len(one))] * 2)
    return [StateGaussians(0, start), StateGaussians(1, end)], motions


def test_what_turned_into_the_light_is_shown_there():
    states, motions = turned_by(math.pi / 2, 0.6)
    stacks = [seen_along_x(0.0)] * 2
    assert abs(dc_to_rgb(torch.tensor(0.6)) - dc_to_rgb(torch.tensor(-1.0))) > 2 * CONFIG.other_colour
    lit = as_lit_there(states, motions, stacks, CONFIG.free_static, CONFIG.free_moving)
    for s in (0, 1):
        assert torch.allclose(lit[s].gaussians.sh, states[1 - s].gaussians.sh, atol=1e-5)
    kept, shown = kept_and_shown(states, motions, 0, lit[0].gaussians, stacks, CONFIG)
    assert kept.all() and shown.all()


def test_another_hue_is_no_light():
    states, motions = turned_by(math.pi / 2, 0.6)
    red = states[1].gaussians.sh * torch.tensor([1.0, -2.5, -2.5])
    states[1] = StateGaussians(
        1, GaussianTensors(*(getattr(states[1].gaussians, n) for n in GaussianTensors.NAMES[:4]), red)
    )
    stacks = [seen_along_x(0.0)] * 2
    lit = as_lit_there(states, motions, stacks, CONFIG.free_static, CONFIG.free_moving)
    assert not kept_and_shown(states, motions, 0, lit[0].gaussians, stacks, CONFIG)[1].any()
