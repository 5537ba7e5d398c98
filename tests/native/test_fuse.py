"""Depth views averaged into a field: the native kernel against torch in float64."""

from dataclasses import replace

import pytest
import torch

from p2gs.ops import se3
from p2gs.surface.depth_view import DepthView, add_normals, pixel_matrix
from p2gs.surface.integrate import integrate, integrate_reference
from p2gs.types import Camera

TRUNC, BEHIND = 0.12, 0.06


def view(seed: int, width: int = 60, height: int = 44) -> DepthView:
    """A wavy wall two units before the camera, of two parts, with holes."""
    g = torch.Generator().manual_seed(seed)
    v, u = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    depth = 2 + 0.3 * torch.sin(5 * u + seed) * torch.cos(4 * v) + 0.5 * (u > 0.7)
    labels = (u > 0.4).long()
    hole = torch.rand(height, width, generator=g) < 0.02
    depth[hole], labels[hole] = 0, -1
    K = torch.tensor([[50.0, 0, width / 2], [0, 52, height / 2], [0, 0, 1]])
    pose = se3.exp(0.1 * torch.randn(6, generator=g).double()).float()
    return add_normals(
        DepthView(
            Camera(pose, K, width, height), depth, labels, (torch.rand(height, width, 3, generator=g) * 255).byte()
        ),
        0.1,
    )


def setting(n: int, count: int = 5):
    views = [view(seed, 60 + seed, 44 - seed) for seed in range(count)]
    poses = [se3.exp(0.05 * torch.randn(6).double()) for _ in views]
    # some beside and behind the views
    points = torch.rand(n, 3) * torch.tensor([3.0, 2.4, 2.4]) - torch.tensor([1.5, 1.2, -1.0])
    return points, views, [pixel_matrix(v.camera, T) for v, T in zip(views, poses, strict=True)]


def assert_follows(points, views, matrices, part):
    """Rounding may carry a point into the next pixel."""
    ours = integrate(points, views, matrices, part, TRUNC, BEHIND)
    exact = integrate_reference(points.double(), views, matrices, part, TRUNC, BEHIND)
    for a, b in zip(ours, exact, strict=True):
        assert a.dtype == torch.float32 and a.shape == b.shape
        if a.numel():
            # colours of sightings that weigh next to nothing are rounded off before they are divided
            close = (
                torch.isclose(a.double(), b, atol=1e-3 if a.ndim == 2 else 2e-5, rtol=1e-4).reshape(len(a), -1).all(1)
            )
            assert float(close.float().mean()) > 0.998


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 2049, 20000])
@pytest.mark.parametrize("part", [0, 1, 7])
def test_follows_torch(isa, threads, n, part):
    assert_follows(*setting(n), part)


def test_the_twins_agree_about_something(isa):
    field, weight, *_ = integrate(*setting(20000), 1, TRUNC, BEHIND)
    assert float(field.min()) < -0.4 and float(field.max()) == 1.0
    assert 0.02 < float((weight > 0).float().mean()) < 0.5 and float((field == 0).float().mean()) > 0.1


def test_no_views(isa):
    field, weight, colour, _ = integrate(torch.rand(20, 3), [], [], 0, TRUNC, BEHIND)
    assert not field.any() and not weight.any() and bool(colour.isfinite().all())


def test_strided_maps_are_taken(isa):
    points, views, matrices = setting(3000)
    names = ("depth", "labels", "normal_dot", "cosine", "colour")
    turned = [
        replace(v, **{n: getattr(v, n).transpose(0, 1).contiguous().transpose(0, 1) for n in names}) for v in views
    ]
    plain, strided = (integrate(points, v, matrices, 1, TRUNC, BEHIND) for v in (views, turned))
    assert all(torch.equal(a, b) for a, b in zip(plain, strided, strict=True))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e38])
def test_points_that_are_not_finite_look_at_no_pixel(isa, bad):
    points, views, matrices = setting(100)
    points[3], points[7, 1], points[20, 2] = bad, bad, bad
    _, weight, *_ = integrate(points, views, matrices, 1, TRUNC, BEHIND)
    assert not weight[[3, 7, 20]].any()


def test_same_bits_for_any_number_of_threads(isa):
    inputs = setting(20000)
    answers = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        answers.append(integrate(*inputs, 1, TRUNC, BEHIND))
    assert all(torch.equal(a, b) for other in answers[1:] for a, b in zip(answers[0], other, strict=True))


def test_views_that_are_not_ready():
    points, views, matrices = setting(10, 2)
    with pytest.raises(ValueError, match="wants depth"):
        integrate(points, [views[0], replace(views[1], cosine=None)], matrices, 0, TRUNC, BEHIND)
    with pytest.raises(ValueError, match="wants depth"):
        integrate(points, [views[0], replace(views[1], depth=views[1].depth[:-1])], matrices, 0, TRUNC, BEHIND)
