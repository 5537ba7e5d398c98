"""How far a drawer went is told by its front's plane; a front that went by two amounts is two drawers'."""

import math
from types import SimpleNamespace

import pytest
import torch

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import shortest_axes
from p2gs.ops import so3
from p2gs.parts.fronts import (
    FEWEST,
    Front,
    Surface,
    border_in,
    front_of,
    part_fronts,
    step_at,
    surfaces_of,
    surfels_of,
    weighed_amounts,
)
from p2gs.types import GaussianTensors
from p2gs.visibility.surfels import Surfels

AXES = torch.eye(3, dtype=torch.float64)
NOISE = 0.004
APART, REACH = 0.005, 0.05


def gaussians(points: torch.Tensor) -> GaussianTensors:
    n = len(points)
    scales = torch.tensor([0.001, 0.02, 0.02]).log().repeat(n, 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return GaussianTensors(points.float(), quats, scales, torch.full((n,), 4.0), torch.zeros(n, 1, 3))


def drawers(amounts: list[float], said: float, noise: float = NOISE, R: torch.Tensor = AXES):
    """Fronts beside one another along y, each 0.4 wide, that went by ``amounts`` along x, one part that is said to have
    gone by ``said``: surfels of both states, judge, motions. R: the world is turned by it."""
    surfels, states, labels = [], [], []
    for s in (0, 1):
        g = torch.Generator().manual_seed(7 + s)
        points = []
        for i, amount in enumerate(amounts):
            yz = torch.rand(200, 2, generator=g).double() * torch.tensor([0.38, 0.2]) + torch.tensor([0.4 * i, 0.0])
            x = s * amount + noise * torch.randn(200, 1, generator=g).double()
            points.append(torch.cat([x, yz], 1))
        at = torch.cat(points) @ R.T
        surfels.append(Surfels(at.float(), R[:, 0].float().expand(len(at), 3), torch.zeros(len(at), 3), 0.02, 0.004))
        states.append(StateGaussians(s, gaussians(at)))
        labels.append(torch.ones(len(at), dtype=torch.int64))
    T = torch.eye(4).double()[None].clone()
    T[0, :3, 3] = said * R[:, 0]
    motions = PartMotions(["prismatic"], T, torch.ones(1), labels, [torch.ones(len(x)) for x in labels])
    return surfels, judge(states), motions


def judge(states, saved: float = 0.1):
    return SimpleNamespace(
        states=states, config=SimpleNamespace(free_moving=REACH), own_share=lambda tried, than: saved
    )


def fronts(surfels, judge, motions):
    surfaces = surfels_of(surfels, judge.states, motions)
    return [front_of(surfaces, motions.transforms[0], 0, s, REACH) for s in (0, 1)]


def test_the_thinnest_axis_is_a_plates_normal():
    g = gaussians(torch.zeros(50, 3))
    for R in (AXES, so3.rotvec_to_matrix(torch.tensor([0.3, -0.5, 0.7]).double())):
        turned = g.placed(g.means, so3.matrix_to_quat(R).float().expand(50, 4))
        assert torch.allclose((shortest_axes(turned) @ R[:, 0].float()).abs(), torch.ones(50), atol=1e-5)


@pytest.mark.parametrize("said", [0.18, 0.2, 0.215])
def test_a_fronts_plane_says_how_much_farther_it_went(said):
    scene = drawers([0.2], said)
    for state, front in enumerate(fronts(*scene)):
        assert len(front) > 190 and abs(front.amount - (0.2 - said)) < 0.0015
        assert front.spread == pytest.approx(math.sqrt(2) * NOISE, rel=0.25)
        assert float(front.points[:, 0].abs().max()) < 6 * NOISE or state  # where it is at the start
    gaussians_ = surfaces_of(scene[1].states, scene[2])
    alike = front_of(gaussians_, scene[2].transforms[0], 0, 1, REACH)  # the Gaussians are where surfels are
    assert torch.equal(alike.farther, front.farther)


def test_of_what_no_front_shows_nothing_is_said():
    surfels, one, motions = drawers([0.2], 0.19)
    along = [Surface(s.points, AXES[1].expand(len(s.points), 3), s.labels) for s in surfaces_of(one.states, motions)]
    assert len(front_of(along, motions.transforms[0], 0, 0, REACH)) == 0
    ways = {"forward": motions.transforms + 0.01, "backward": motions.transforms}
    motions.types[0] = "revolute"
    assert weighed_amounts(one.states, motions, ways, REACH) == (motions, [])
    motions.types[0], motions.labels[1] = "prismatic", torch.zeros_like(motions.labels[1])  # one state shows it
    assert not any(map(len, fronts(surfels, one, motions)))
    assert weighed_amounts(one.states, motions, ways, REACH) == (motions, [])


@pytest.mark.parametrize("step", [0.008, -0.012])
def test_a_front_that_went_by_two_amounts_is_parted_where_they_meet(step):
    surfels, one, motions = drawers([0.2, 0.2 + step], 0.2)
    both = fronts(surfels, one, motions)
    border = border_in(both, AXES[1:])
    assert border is not None
    found = step_at(both, *border)
    assert found is not None and found.alike and abs(float(found.normal[1])) == 1 and 0.36 < found.offset < 0.42
    assert found.farther[1] - found.farther[0] == pytest.approx(step, abs=0.0015)
    two, (told, *_) = part_fronts(one, one.states, surfels, motions, AXES, APART, 5)
    assert two.types == ["prismatic"] * 2 and len(two.confidence) == 2
    assert two.transforms[:, 0, 3].tolist() == pytest.approx([0.2, 0.2 + step], abs=0.0015) == told["amounts"]
    for s in (0, 1):
        right = torch.tensor([1, 2]).repeat_interleave(200)
        assert float((two.labels[s] == right).float().mean()) > 0.98


def test_three_drawers_become_three():
    surfels, one, motions = drawers([0.2, 0.21, 0.19], 0.2)
    three, _ = part_fronts(one, one.states, surfels, motions, AXES, APART, 5)
    assert sorted(three.transforms[:, 0, 3].tolist()) == pytest.approx([0.19, 0.2, 0.21], abs=0.002)


@pytest.mark.parametrize(
    "amounts, noise, saved, limit",
    [
        ([0.2, 0.2], NOISE, 0.1, 5),  # they went alike
        ([0.2, 0.203], NOISE, 0.1, 5),  # by less than surfaces tell apart
        ([0.2, 0.208], 0.04, 0.1, 5),  # by less than their noise tells
        ([0.2, 0.208], NOISE, -0.1, 5),  # the photographs are against it
        ([0.2, 0.208], NOISE, 0.1, 1),  # no further part was asked for
    ],
)
def test_one_body_stays_one(amounts, noise, saved, limit):
    surfels, one, motions = drawers(amounts, 0.2, noise)
    same, _ = part_fronts(judge(one.states, saved), one.states, surfels, motions, AXES, APART, limit)
    assert same is motions


def test_few_points_are_not_parted_and_turns_have_no_front():
    surfels, one, motions = drawers([0.2, 0.21], 0.2)
    few = [Front(f.points[: FEWEST + 5], f.farther[: FEWEST + 5]) for f in fronts(surfels, one, motions)]
    assert border_in(few, AXES[1:]) is None and step_at(few, AXES[1], 0.2) is None
    motions.types[0] = "revolute"
    assert part_fronts(one, one.states, surfels, motions, AXES, APART, 5) == (motions, [])


@pytest.mark.parametrize("apart, share", [(0.0, 1.0), (0.0005, 0.0), (NOISE * math.sqrt(2), 0.5), (0.1, 1.0)])
def test_photographs_that_agree_with_themselves_outweigh_the_front(apart, share):
    _, one, motions = drawers([0.2], 0.19)
    other = motions.transforms.clone()
    other[:, 0, 3] += apart
    ways = {"forward": other, "backward": motions.transforms}
    weighed, (told,) = weighed_amounts(one.states, motions, ways, REACH)
    assert told["farther"] == pytest.approx([0.01, 0.01], abs=0.0015) and 0 <= told["weight"] <= 1
    assert float(weighed.transforms[0, 0, 3]) == pytest.approx(0.19 + share * 0.01, abs=0.0015)
    assert weighed_amounts(one.states, motions, {}, REACH) == (motions, [])


def test_the_world_may_be_turned():
    R = so3.rotvec_to_matrix(torch.tensor([0.3, -0.5, 0.7]).double())
    surfels, one, motions = drawers([0.2, 0.21], 0.2, R=R)
    for state in one.states:
        turn = so3.matrix_to_quat(R).float().expand(len(state.gaussians), 4)
        state.gaussians = state.gaussians.placed(state.gaussians.means, turn)
    two, _ = part_fronts(one, one.states, surfels, motions, AXES @ R.T, APART, 5)
    assert two.transforms[:, :3, 3].norm(dim=1).tolist() == pytest.approx([0.2, 0.21], abs=0.0015)
