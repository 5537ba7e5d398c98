"""Light changes as a part turns; colours of two states are compared after a gain per turning part."""

import math
from dataclasses import replace

import pytest
import torch
from test_agreement import facing as seen_along_x
from test_agreement import grid, splats

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.motion.agreement import kept_and_shown
from p2gs.motion.light import FEWEST, as_lit_there, brighter, facing, facing_either, turned_light
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


def gain_of(seen, T: torch.Tensor, turns: bool = True) -> float:
    """Of a surface that faces as the plate does at the start."""
    light = turned_light(*seen, T[None], [turns], 0.05)
    return float(light.gains(torch.ones(1, dtype=torch.long), seen[1][0][:1]))


@pytest.mark.parametrize("factor", [0.6, 1.7])
def test_the_gain_is_how_much_brighter_the_end_is(factor):
    assert gain_of(plates(factor), TURN) == pytest.approx(factor, rel=1e-4)
    exchanged = [x[::-1] for x in plates(factor)]
    assert gain_of(exchanged, se3.inverse(TURN)) == pytest.approx(1 / factor, rel=1e-4)


def test_each_side_has_its_own_light_and_a_tenth_of_wrong_matches_does_not_matter():
    front, back = plates(0.5), plates(1.6)
    back = [[x + 0.02 * n for x, n in zip(back[0], back[1], strict=True)], [-n for n in back[1]], *back[2:]]
    both = [[torch.cat(pair) for pair in zip(*sides, strict=True)] for sides in zip(front, back, strict=True)]
    both[2][1][::10] = 0.9
    light = turned_light(*both, TURN[None], [True], 0.01)
    seen = light.gains(torch.ones(2, dtype=torch.long), torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    assert seen.tolist() == pytest.approx([0.5, 1.6], rel=0.03)
    alike = turned_light(*both, TURN[None], [True], 0.01, alike=True).of[0]
    assert alike[0].exp() == pytest.approx(1.6, rel=0.01) or alike[0].exp() == pytest.approx(0.5, rel=0.01)
    assert not alike[1:].any()


def test_slides_other_sides_and_few_points_have_no_gain():
    seen = plates(0.6)
    assert gain_of(seen, TURN, turns=False) == 1.0
    turned_over = [seen[0], [seen[1][0], -seen[1][1]], *seen[2:]]
    assert gain_of(turned_over, TURN) == 1.0
    few = [[x[: FEWEST // 2 - 1] for x in both] for both in seen]
    assert gain_of(few, TURN) == 1.0
    apart = [[seen[0][0], seen[0][1] + 1.0], *seen[1:]]
    assert gain_of(apart, TURN) == 1.0


def test_brighter_multiplies_the_colour_from_every_direction():
    gen = torch.Generator().manual_seed(1)
    g = splats(torch.randn(5, 3, generator=gen))
    g = replace(g, sh=0.3 * torch.randn(5, 4, 3, generator=gen))
    gains = torch.tensor([1.0, 0.5, 2.0, 0.5, 1.0])
    way = torch.nn.functional.normalize(torch.randn(5, 3, generator=gen), dim=1)
    before, after = (evaluate(x.sh, way) for x in (g, brighter(g, gains)))
    assert torch.allclose(after, before * gains[:, None], atol=1e-6)


def test_gaussians_face_those_who_see_them():
    g = splats(grid(0.0))
    for side in (1.0, -1.0):
        normal = facing(g, seen_along_x(0.0, side), CONFIG.free_static)
        assert torch.allclose(normal, torch.tensor([side, 0.0, 0.0]).expand(len(g), 3))
    assert not facing(g, seen_along_x(0.5), CONFIG.free_static).any()  # hidden behind another plane


def test_a_twin_faces_those_who_see_it_in_either_state():
    """Seen at the end alone, turned by a quarter."""
    T = se3.from_screw(torch.tensor([0.0, 0.0, 1.0]).double(), torch.zeros(3).double(), -math.pi / 2)
    g, one = splats(se3.apply(se3.inverse(T).float(), grid(0.0))), torch.ones(len(grid(0.0)), dtype=torch.long)
    quats = torch.zeros(len(g), 4)
    quats[:, 0] = quats[:, 3] = math.sqrt(0.5)  # a quarter about z
    g = replace(g, quats=quats)
    for side in (1.0, -1.0):
        stacks = [seen_along_x(9.0), seen_along_x(0.0, side)]
        normal = facing_either(g, one, T[None], stacks, CONFIG.free_static)
        assert torch.allclose(normal, torch.tensor([0.0, side, 0.0]).expand(len(g), 3), atol=1e-5)


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
