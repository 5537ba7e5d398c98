"""How far a drawer went is told by its front's plane; a front that went by two amounts is two drawers'."""

import math
from types import SimpleNamespace

import pytest
import torch

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.gaussians.pose import shortest_axes
from p2gs.motion.fronts import FEWEST, front_of, part_fronts, step_in, weighed_amounts
from p2gs.ops import so3
from p2gs.types import GaussianTensors

WAY = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
AXES = torch.eye(3, dtype=torch.float64)
NOISE = 0.004
APART, REACH = 0.005, 0.05


def flat(points: torch.Tensor, normal: torch.Tensor, seed: int = 0) -> GaussianTensors:
    """Solid plates at points [N, 3], thin along a normal [3] to within a degree."""
    n, g = len(points), torch.Generator().manual_seed(seed)
    half = torch.linalg.cross(torch.tensor([1.0, 0.0, 0.0]), normal.float())
    quat = torch.cat([1 + normal[:1].float(), half]) if float(normal[0]) > -0.9 else torch.tensor([0.0, 0.0, 1.0, 0.0])
    quats = so3.quat_normalize(quat.expand(n, 4) + 0.01 * torch.randn(n, 4, generator=g))
    scales = torch.tensor([0.001, 0.02, 0.02]).log().repeat(n, 1)
    return GaussianTensors(points.float(), quats, scales, torch.full((n,), 4.0), torch.zeros(n, 1, 3))


def drawers(amounts: list[float], said: float, noise: float = NOISE, labels: list[int] | None = None):
    """Fronts beside one another along y, each 0.4 wide, that went by ``amounts`` along x; all of one part that is said
    to have gone by ``said`` (or of ``labels``, each by that)."""
    states, labels, of = [], labels or [1] * len(amounts), []
    for s in (0, 1):
        g = torch.Generator().manual_seed(7 + s)
        points = []
        for i, amount in enumerate(amounts):
            yz = torch.rand(200, 2, generator=g).double() * torch.tensor([0.38, 0.2]) + torch.tensor([0.4 * i, 0.0])
            x = s * amount + noise * torch.randn(200, 1, generator=g).double()
            points.append(torch.cat([x, yz], 1))
        states.append(StateGaussians(s, flat(torch.cat(points), WAY, s)))
        of.append(torch.tensor(labels).repeat_interleave(200))
    T = torch.eye(4).double().repeat(max(labels), 1, 1)
    T[:, 0, 3] = said
    count = max(labels)
    motions = PartMotions(["prismatic"] * count, T, torch.ones(count), of, [torch.ones(len(x)) for x in of])
    return states, motions


def judge(saved: float = 0.1):
    return SimpleNamespace(own_share=lambda tried, than: saved)


def test_the_thinnest_axis_is_a_plates_normal():
    for normal in (torch.tensor([1.0, 0, 0]), torch.tensor([0, 0.6, 0.8]), torch.tensor([-1.0, 0, 0])):
        assert float((shortest_axes(flat(torch.zeros(50, 3), normal)) @ normal).abs().min()) > 0.99


@pytest.mark.parametrize("state", [0, 1])
@pytest.mark.parametrize("said", [0.18, 0.2, 0.215])
def test_a_fronts_plane_says_how_much_farther_it_went(state, said):
    states, motions = drawers([0.2], said)
    front = front_of(states, motions, 0, state, REACH)
    assert len(front) > 190 and abs(front.amount - (0.2 - said)) < 0.0015
    assert front.spread == pytest.approx(math.sqrt(2) * NOISE, rel=0.25)
    assert float(front.points[:, 0].abs().max()) < 6 * NOISE or state  # where it is at the start


def test_what_stands_along_the_way_is_no_front():
    states, motions = drawers([0.2], 0.2)
    for s in (0, 1):
        states[s] = StateGaussians(s, flat(states[s].gaussians.means, torch.tensor([0.0, 0.0, 1.0])))
    assert len(front_of(states, motions, 0, 0, REACH)) == 0


def test_of_a_part_that_one_state_does_not_show_nothing_is_said():
    states, motions = drawers([0.2], 0.19)
    motions.labels[1] = torch.zeros_like(motions.labels[1])
    assert len(front_of(states, motions, 0, 0, REACH)) == 0
    ways = {"forward": motions.transforms + 0.01, "backward": motions.transforms}
    assert weighed_amounts(states, motions, ways, REACH) == (motions, [])


@pytest.mark.parametrize("step", [0.008, -0.012])
def test_a_front_that_went_by_two_amounts_is_parted_where_they_meet(step):
    states, motions = drawers([0.2, 0.2 + step], 0.2)
    found = step_in([front_of(states, motions, 0, s, REACH) for s in (0, 1)], AXES[1:], APART)
    assert found is not None and abs(float(found.normal[1])) == 1 and 0.36 < found.offset < 0.42
    assert found.farther[1] - found.farther[0] == pytest.approx(step, abs=0.0015)
    two, (told,) = part_fronts(judge(), states, motions, AXES, apart=APART, reach=REACH, limit=5)
    assert two.types == ["prismatic"] * 2 and len(two.confidence) == 2
    assert two.transforms[:, 0, 3].tolist() == pytest.approx([0.2, 0.2 + step], abs=0.0015) == told["amounts"]
    for s in (0, 1):
        right = torch.tensor([1, 2]).repeat_interleave(200)
        assert float((two.labels[s] == right).float().mean()) > 0.98


def test_three_drawers_become_three():
    states, motions = drawers([0.2, 0.21, 0.19], 0.2)
    three, log = part_fronts(judge(), states, motions, AXES, apart=APART, reach=REACH, limit=5)
    assert sorted(three.transforms[:, 0, 3].tolist()) == pytest.approx([0.19, 0.2, 0.21], abs=0.002) and len(log) == 2


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
    states, motions = drawers(amounts, 0.2, noise)
    one, _ = part_fronts(judge(saved), states, motions, AXES, apart=APART, reach=REACH, limit=limit)
    assert one is motions


def test_a_front_that_leans_evenly_is_one_body_to_the_eye_of_few_points():
    states, motions = drawers([0.2], 0.2)
    few = [f for f in (front_of(states, motions, 0, s, REACH) for s in (0, 1))]
    few = [type(f)(f.points[: FEWEST + 5], f.farther[: FEWEST + 5]) for f in few]
    assert step_in(few, AXES[1:], APART) is None


def test_turns_have_no_front():
    states, motions = drawers([0.2, 0.21], 0.2)
    motions.types[0] = "revolute"
    one, log = part_fronts(judge(), states, motions, AXES, apart=APART, reach=REACH, limit=5)
    assert one is motions and not log


@pytest.mark.parametrize("apart, share", [(0.0, 1.0), (0.0005, 0.0), (NOISE * math.sqrt(2), 0.5), (0.1, 1.0)])
def test_photographs_that_agree_with_themselves_outweigh_the_front(apart, share):
    states, motions = drawers([0.2], 0.19)
    other = motions.transforms.clone()
    other[:, 0, 3] += apart
    ways = {"forward": other, "backward": motions.transforms}
    weighed, (told,) = weighed_amounts(states, motions, ways, REACH)
    assert told["farther"] == pytest.approx([0.01, 0.01], abs=0.0015) and 0 <= told["weight"] <= 1
    assert float(weighed.transforms[0, 0, 3]) == pytest.approx(0.19 + share * 0.01, abs=0.0015)
    assert weighed_amounts(states, motions, {}, REACH) == (motions, [])


def test_the_world_may_be_turned():
    states, motions = drawers([0.2, 0.21], 0.2)
    R = so3.rotvec_to_matrix(torch.tensor([0.3, -0.5, 0.7]).double())
    for s in (0, 1):
        g = states[s].gaussians
        quats = so3.quat_multiply(so3.matrix_to_quat(R).float().expand(len(g), 4), g.quats)
        states[s] = StateGaussians(s, g.placed((g.means.double() @ R.T).float(), quats))
    motions.transforms[:, :3, 3] = motions.transforms[:, :3, 3] @ R.T
    two, _ = part_fronts(judge(), states, motions, AXES @ R.T, apart=APART, reach=REACH, limit=5)
    assert two.transforms[:, :3, 3].norm(dim=1).tolist() == pytest.approx([0.2, 0.21], abs=0.0015)
