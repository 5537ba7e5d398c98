"""Points on which photographs agree: an open box whose inside is plain but for its shading, seen from above."""

import math

import pytest
import torch

from p2gs.gaussians.views import look_at
from p2gs.models import swept
from p2gs.models.initial import initial_points
from p2gs.models.swept import swept_points
from p2gs.ops.rays import camera_rays
from p2gs.types import TwoStateScene, View

SIZE = 96
BOX = torch.tensor([[-0.6, -0.6, -0.5], [0.6, 0.6, 0.5]])  # open at the top, z = 0.5
AROUND = torch.tensor([[-0.8, -0.8, -0.7], [0.8, 0.8, 0.7]])


def hit(start: torch.Tensor, ways: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances at which rays [..., 3] from outside meet the open box, inf where they miss it, and the colours there:
    outside by place, inside a grey that falls off towards the floor."""
    low, high = ((side - start) / ways for side in BOX)
    near, far = torch.minimum(low, high).amax(-1), torch.maximum(low, high).amin(-1)
    entry = start + near[..., None] * ways
    inside = (entry[..., 2] > BOX[1, 2] - 1e-4) & (near < far)
    t = torch.where(inside, far, near).where(near < far, torch.inf)
    at = start + t.nan_to_num(posinf=0)[..., None] * ways
    shade = 0.25 + 0.2 * (at[..., 2:] + 0.1 * at[..., :1]) / BOX[1, 2]
    pattern = torch.stack([(7 * at[..., 0]).sin(), (6 * at[..., 1]).cos(), (8 * at[..., 2]).sin()], -1) / 2 + 0.5
    return t, torch.where(inside[..., None], shade.expand_as(pattern), pattern)


def plain(start: torch.Tensor, ways: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """As ``hit``, of the box with a top and each side in one colour."""
    low, high = ((side - start) / ways for side in BOX)
    near, far = torch.minimum(low, high), torch.maximum(low, high).amin(-1)
    t, axis = near.max(-1)
    side = (ways.gather(-1, axis[..., None])[..., 0] > 0).float()
    colour = torch.stack([0.8 - 0.15 * axis, 0.5 + 0.2 * side, 0.3 + 0.2 * axis], -1)
    return torch.where(t < far, t, torch.inf), colour


def photograph(number: int, count: int, noise: float, scene=hit) -> View:
    """From a spiral above the box, 2.5 from its middle."""
    turn, up = 2.4 * number, math.radians(15 + 60 * number / count)
    eye = 2.5 * torch.tensor([math.cos(turn) * math.cos(up), math.sin(turn) * math.cos(up), math.sin(up)])
    camera = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1]), SIZE, SIZE, 1.3 * SIZE)
    ways = camera_rays(camera) @ camera.viewmat[:3, :3]
    t, colour = scene(eye, ways)
    g = torch.Generator().manual_seed(number)
    colour = (colour + noise * torch.randn(colour.shape, generator=g)).clamp(0, 1)
    alpha = torch.isfinite(t)
    return View(
        f"{number:02d}", 0, "train", camera, (colour * 255).round().byte() * alpha[..., None],
        alpha.byte() * 255,
    )  # fmt: skip


@pytest.fixture(scope="module")
def views() -> list[View]:
    return [photograph(k, 24, noise=0.01) for k in range(24)]


def off(points: torch.Tensor) -> torch.Tensor:
    """Distances [N] from points to the nearest of the five sides."""
    beyond = torch.maximum(BOX[0] - points, points - BOX[1]).clamp_min(0).norm(dim=1)
    sides = torch.cat([(points - BOX[0]).abs(), (points - BOX[1]).abs()[:, :2]], 1).amin(1)
    return torch.maximum(sides, beyond)


def test_points_lie_on_the_sides_within_and_without(views):
    points, colours = swept_points(views, AROUND)
    assert len(points) > 2000 and points.shape == colours.shape
    assert float((off(points) < 0.05).float().mean()) > 0.9
    floor = (points[:, :2].abs() < 0.4).all(1)
    assert int(floor.sum()) > 50
    assert (
        float((points[floor, 2] < 0).float().mean()) > 0.9
    )  # no lid at the rim, which is at 0.5; the floor is at -0.5
    assert float((colours[floor] - 0.05).abs().median()) < 0.05  # as dark as the floor is


def test_points_of_plain_sides_lie_no_deeper_than_these(monkeypatch):
    pictures = [photograph(k, 24, 0.01, plain) for k in range(24)]

    def far_inside() -> float:
        points, _ = swept_points(pictures, AROUND)
        depth = torch.minimum(points - BOX[0], BOX[1] - points).amin(1)
        assert float((depth.abs() < 0.06).float().mean()) > 0.9
        return float((depth > 0.06).float().mean())

    nearest = far_inside()
    monkeypatch.setattr(swept, "SHORT", 0.0)  # where most agree
    assert nearest < 0.03 and far_inside() > 3 * nearest


def test_colours_are_those_of_the_photographs_and_order_does_not_matter(views):
    points, _ = swept_points(views, AROUND)
    turned, _ = swept_points(views[::-1], AROUND)
    assert {tuple(p) for p in points.mul(1000).round().tolist()} == {
        tuple(p) for p in turned.mul(1000).round().tolist()
    }


def test_photographs_of_several_sizes_are_compared(views):
    smaller = views[0]
    small = View(
        "small", 0, "train", smaller.camera.scaled(SIZE // 2, SIZE // 2), smaller.image[::2, ::2].contiguous(),
        smaller.alpha[::2, ::2].contiguous(),
    )  # fmt: skip
    points, _ = swept_points([small, *views[1:]], AROUND)
    assert float((off(points) < 0.05).float().mean()) > 0.9


def test_a_state_starts_on_them_and_on_random_points_where_they_are_too_few(views):
    scene = TwoStateScene("box", tuple(views), box=AROUND)
    start = initial_points(scene, 0, (500, 0), "agreed", torch.Generator().manual_seed(1))
    assert len(start.points) == 500 and bool(start.known.all())
    found = len(swept_points(views, AROUND)[0])
    start = initial_points(scene, 0, (found + 100, 0), "agreed", torch.Generator().manual_seed(1))
    assert start.known.sum() == found and len(start.points) == found + 100
    assert torch.equal(start.colours[~start.known], torch.full((100, 3), 0.5))


def test_one_photograph_tells_no_depth(views):
    points, colours = swept_points(views[:1], AROUND)
    assert points.shape == colours.shape == (0, 3)
