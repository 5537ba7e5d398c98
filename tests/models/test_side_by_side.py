"""Drawers that abut and go alike are told apart by their trays: a gap between them that is narrower than either."""

import pytest
import torch

from p2gs.gaussians.handover import PartMotions, StateGaussians
from p2gs.ops import se3, so3
from p2gs.parts.fronts import surfels_of
from p2gs.parts.side_by_side import gap_behind, part_side_by_side
from p2gs.types import GaussianTensors
from p2gs.visibility.surfels import Surfels

AXES = torch.eye(3, dtype=torch.float64)
SPACING, APART, WENT = 0.02, 0.005, 0.3
STILL = torch.eye(4, dtype=torch.float64)


def sheet(u: tuple[float, float], v: tuple[float, float], axis: int, at: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [N, 3] and normals of a rectangle across ``axis``; u, v: its ranges along the other two."""
    grids = [torch.arange(a + SPACING / 2, b, SPACING, dtype=torch.float64) for a, b in (u, v)]
    points = torch.zeros(len(grids[0]) * len(grids[1]), 3, dtype=torch.float64)
    others = [i for i in range(3) if i != axis]
    points[:, others], points[:, axis] = torch.cartesian_prod(*grids), at
    return points, AXES[axis].expand(len(points), 3)


def drawers(trays: list[tuple[float, ...]], T: torch.Tensor = STILL, opens: bool = True):
    """One plain front across x, 1 wide (y) and 0.2 high, before bottoms of trays that reach from y to y (and lie at z):
    nothing but the front shows while they are shut. The world is placed by T. opens: shut at the start, else at the
    end."""
    front = sheet((0.0, 1.0), (0.0, 0.2), 0, 0.0)
    behind = [sheet((-0.4, -0.02), (least, most), 2, *(z or [0.02])) for least, most, *z in trays]
    surfels, states, labels = [], [], []
    for s in (0, 1):
        shut = s == (0 if opens else 1)
        points, normals = (torch.cat(x) for x in zip(front, *([] if shut else behind), strict=True))
        points = se3.apply(T, points + (0.0 if shut else WENT) * AXES[0])
        normals, n = (normals @ T[:3, :3].T).float(), len(points)
        surfels.append(Surfels(points.float(), normals, torch.zeros(n, 3), SPACING, 0.002))
        scales, quats = torch.tensor([0.001, 0.01, 0.01]).log().repeat(n, 1), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
        g = GaussianTensors(points.float(), quats, scales, torch.full((n,), 4.0), torch.zeros(n, 1, 3))
        states.append(StateGaussians(s, g))
        labels.append(torch.ones(n, dtype=torch.int64))
    move = torch.eye(4).double()
    move[:3, 3] = (WENT if opens else -WENT) * T[:3, 0]
    margin = [torch.ones(len(x)) for x in labels]
    return states, surfels, PartMotions(["prismatic"], move[None], torch.ones(1), labels, margin)


def seen_through(lines: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    return torch.ones(lines.shape[1], dtype=torch.bool)


def turned() -> torch.Tensor:
    return se3.make(
        so3.rotvec_to_matrix(torch.tensor([0.2, -0.4, 0.9]).double()), torch.tensor([0.1, 0.2, -0.3]).double()
    )


@pytest.mark.parametrize("opens", [True, False])
@pytest.mark.parametrize("T", [STILL, turned()])
def test_two_trays_behind_one_front_are_two_parts(T, opens):
    states, surfels, motions = drawers([(0.04, 0.44), (0.56, 0.96)], T, opens)
    two, log = part_side_by_side(states, surfels, motions, T[:3, :3].T, APART, 5, seen_through)
    assert [x["parts"] for x in log] == [[0, 1]] and log[0]["gap"] == pytest.approx(0.14, abs=SPACING)
    assert log[0]["widths"] == pytest.approx([0.38, 0.38], abs=SPACING)
    assert two.types == ["prismatic"] * 2 and torch.equal(two.transforms, motions.transforms.repeat(2, 1, 1))
    for s, state in enumerate(states):
        local = se3.apply(se3.inverse(T), state.gaussians.means.double())
        sides = [two.labels[s] == k for k in (1, 2)]
        first = local[sides[0]][:, 1]
        assert bool((first < 0.5).all()) or bool((first > 0.5).all())
        assert bool((sides[0] | sides[1]).all()) and 0.4 < float(sides[0].float().mean()) < 0.6


@pytest.mark.parametrize(
    "trays",
    [
        [(0.04, 0.96)],  # one
        [(0.0, 0.06), (0.94, 1.0)],  # the rims of one of which the bottom is not seen
        [(0.04, 0.3), (0.66, 0.96)],  # a gap wider than the pieces
        [(0.04, 0.49, 0.02), (0.51, 0.96, 0.15)],  # apart only in height, where they are not parted from end to end
        [],
    ],
)
def test_what_is_no_pair_of_trays_stays_one(trays):
    states, surfels, motions = drawers(trays)
    assert part_side_by_side(states, surfels, motions, AXES, APART, 5, seen_through) == (motions, [])


def test_three_become_three_as_far_as_parts_may_be_had():
    states, surfels, motions = drawers([(0.02, 0.3), (0.36, 0.64), (0.7, 0.98)])
    three, log = part_side_by_side(states, surfels, motions, AXES, APART, 5, seen_through)
    assert len(three) == 3 and len(log) == 2
    assert sorted(torch.bincount(three.labels[1])[1:].tolist()) == pytest.approx([495] * 3, rel=0.2)
    assert len(part_side_by_side(states, surfels, motions, AXES, APART, 2, seen_through)[0]) == 2


def test_turns_and_directions_along_the_way_are_not_asked():
    states, surfels, motions = drawers([(0.04, 0.44), (0.56, 0.96)])
    surfaces = surfels_of(surfels, states, motions)
    assert gap_behind(surfaces, motions.transforms[0], 0, AXES[[0, 2]], SPACING, APART, seen_through) is None
    assert gap_behind(surfaces, motions.transforms[0], 0, AXES[:0], SPACING, APART, seen_through) is None
    motions.types[0] = "revolute"
    assert part_side_by_side(states, surfels, motions, AXES, APART, 5, seen_through) == (motions, [])


@pytest.mark.parametrize("state", [0, 1])
def test_a_tray_without_a_front_is_no_drawer(state):
    states, surfels, motions = drawers([(0.04, 0.44), (0.56, 0.96)])
    surfaces = surfels_of(surfels, states, motions)
    asked = {"T": motions.transforms[0], "part": 0, "directions": AXES, "spacing": SPACING, "apart": APART}
    asked["look"] = seen_through
    assert gap_behind(surfaces, **asked) is not None
    across = (surfaces[state].normals[:, 0].abs() > 0.9) & (surfaces[state].points[:, 1] > 0.5)
    surfaces[state].labels[across] = 0
    assert gap_behind(surfaces, **asked) is None


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_most_looks_must_go_through_the_gap(share):
    """Of a tray under another one what is seen is at its sides: nobody saw that there is nothing between them."""
    states, surfels, motions = drawers([(0.04, 0.44), (0.56, 0.96)])
    asked = []

    def look(lines, motion):
        asked.append((lines, motion))
        return torch.arange(lines.shape[1]) < share * lines.shape[1]

    two, log = part_side_by_side(states, surfels, motions, AXES, APART, 2, look)
    assert len(two) == len(log) + 1 == (2 if share > 0.5 else 1)
    lines, motion = asked[0]
    assert bool(((lines[..., 1] > 0.43) & (lines[..., 1] < 0.57)).all()) and torch.equal(motion, motions.transforms[0])
