"""Planes of Gaussians and where rays meet them: the native kernels against torch in float64, and against geometry."""

import pytest
import torch

from p2gs.ops import so3
from p2gs.ops.planes import (
    plane_depth,
    plane_error,
    plane_error_reference,
    plane_features,
    plane_features_reference,
    planes,
)
from p2gs.ops.rays import camera_rays
from p2gs.types import Camera


def camera(h=23, w=31, seed=3):
    g = torch.Generator().manual_seed(seed)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = so3.quat_to_matrix(so3.quat_normalize(torch.randn(4, generator=g, dtype=torch.float64)))
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 3.0], dtype=torch.float64)
    K = torch.tensor([[1.3 * w, 0.0, w / 2], [0.0, 1.2 * h, h / 2 + 1], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(viewmat, K, w, h)


def gaussians(n, seed=0):
    g = torch.Generator().manual_seed(seed)
    means, quats = torch.randn(n, 3, generator=g), 3 * torch.randn(n, 4, generator=g)
    return means, quats, torch.randn(n, 3, generator=g) - 4


def rendered(view, seed=1):
    """Accumulated features of a wall that is met nearly everywhere, some of it edge-on or from behind."""
    g = torch.Generator().manual_seed(seed)
    shape = (view.height, view.width)
    normal = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=g) + torch.tensor([0.0, 0.0, 2.0]), dim=-1)
    return torch.cat([normal, 2 + torch.rand(*shape, 1, generator=g)], -1) * (0.2 + torch.rand(*shape, 1, generator=g))


def test_plane_of_a_flat_and_of_a_round_gaussian():
    eye = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    means = torch.tensor([[1.0, 2.0, 0.5], [1.0, 2.0, 0.5]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(2, 4)
    log_scales = torch.tensor([[0.1, 0.1, 1e-4], [0.1, 0.1, 0.1]], dtype=torch.float64).log()
    normal, distance = planes(means, quats, log_scales, eye)
    away = means[1] - eye
    assert torch.allclose(normal[0], torch.tensor([0.0, 0, -1], dtype=torch.float64), atol=1e-5)
    assert distance[0].item() == pytest.approx(4.5, abs=1e-4)
    assert torch.allclose(normal[1], away / away.norm())
    assert distance[1].item() == pytest.approx(away.norm().item())


def test_features_follow_torch(threads):
    given, view = gaussians(5000), camera()
    weights = torch.randn(5000, 4, generator=torch.Generator().manual_seed(2))

    def run(f, leaves, w):
        leaves = [t.clone().requires_grad_() for t in leaves]
        out = f(*leaves, view)
        return out.detach(), torch.autograd.grad((out * w).sum(), leaves)

    ours, grads = run(plane_features, given, weights)
    exact, true = run(plane_features_reference, [t.double() for t in given], weights.double())
    assert (ours - exact).abs().max() < 1e-4
    for a, b in zip(grads, true, strict=True):
        assert (a - b).norm() <= 1e-3 * b.norm()


def test_features_gradient():
    given = [t.double().requires_grad_() for t in gaussians(6)]
    assert torch.autograd.gradcheck(lambda *g: plane_features_reference(*g, camera()), given)


def test_error_follows_torch(threads):
    view = camera(57, 83)
    features, rays = rendered(view), camera_rays(view)
    g = torch.Generator().manual_seed(4)
    depth = 2 + torch.rand(57, 83, generator=g)
    counted = torch.rand(57, 83, generator=g) > 0.2
    results = []
    for f, cast in ((plane_error, torch.Tensor.float), (plane_error_reference, torch.Tensor.double)):
        leaf = cast(features).clone().requires_grad_()
        out = f(leaf, cast(rays), cast(depth), counted)
        results.append((out.detach(), torch.autograd.grad(3 * out, leaf)[0]))
    (ours, grad), (exact, true) = results
    assert ours.item() == pytest.approx(exact.item(), rel=1e-5) and exact > 0
    assert (grad - true).norm() <= 1e-4 * true.norm()
    assert 0 < (true != 0).any(-1).sum() < counted.sum()  # some are met edge-on


def test_error_gradient():
    view = camera(4, 5)
    leaf, rays = rendered(view).double().requires_grad_(), camera_rays(view).double()
    depth, counted = torch.full((4, 5), 2.5).double(), torch.ones(4, 5, dtype=torch.bool)
    assert torch.autograd.gradcheck(lambda f: plane_error_reference(f, rays, depth, counted), leaf)


def test_nothing_counted_is_no_error():
    view = camera(4, 5)
    for f in (plane_error, plane_error_reference):
        leaf = rendered(view).requires_grad_()
        out = f(leaf, camera_rays(view), torch.ones(4, 5), torch.zeros(4, 5, dtype=torch.bool))
        out.backward()
        assert out.item() == 0 and leaf.grad.abs().max() == 0


def test_depth_of_a_wall_is_exact_from_any_weights():
    """Gaussians in one plane, however they are mixed in a pixel: the depth at which the pixel's ray meets the plane."""
    view = camera()
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64), dim=0)
    weight = torch.rand(view.height, view.width, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    rays = camera_rays(view).double()
    found = plane_depth(torch.cat([normal, torch.tensor([2.0])]) * (weight + 0.1), rays)
    assert torch.allclose(found, 2 / (rays @ normal))
