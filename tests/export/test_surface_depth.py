"""Depth of surfaces made of large flat Gaussians is where rays meet them, from any side."""

import math

import pytest
import torch
from toy import ring

from p2gs.gaussians.paint import draw
from p2gs.ops import so3
from p2gs.ops.planes import planes
from p2gs.ops.rays import camera_rays
from p2gs.surface.surface_depth import surface_depth
from p2gs.types import GaussianTensors


def gaussians(means, scales, quats=None, logit=4.0):
    n = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1) if quats is None else quats
    return GaussianTensors(
        means, quats, torch.as_tensor(scales).expand(n, 3).log(), torch.full((n,), logit), torch.zeros(n, 1, 3)
    )


def plane_depth(camera, height):
    """Depth at which pixels meet the plane z = height, [H, W]."""
    W = camera.viewmat.double()
    normal, eye = W[:3, 2], camera.position.double()
    return (height - eye[2]) / (camera_rays(camera).double() @ normal)


@pytest.mark.parametrize("elevation", [20.0, 60.0])
def test_one_flat_gaussian_is_a_plane(elevation):
    g = gaussians(torch.zeros(1, 3), [0.3, 0.2, 1e-4])
    camera = ring(1, 120, elevations=(elevation,))[0]
    depth, spread = surface_depth(g, camera)
    hit = draw(g, camera, 0.0).alpha > 0.05
    torch.testing.assert_close(depth[hit].double(), plane_depth(camera, 0.0)[hit], atol=2e-4, rtol=0)
    assert (
        hit.sum() > 100
        and float(spread[hit].max()) < 2e-3
        and float(depth[draw(g, camera, 0.0).alpha == 0].abs().max()) == 0
    )


def test_grazed_surface_of_large_gaussians_is_where_it_is():
    """Composited from middles it is nearer, by a good part of the Gaussians' size."""
    flat = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    flat[:, 2] = 0
    g = gaussians(flat, [0.12, 0.12, 1e-3])
    camera = ring(1, 160, elevations=(12.0,))[0]
    out, truth = draw(g, camera, 0.0), plane_depth(camera, 0.0)
    solid = out.alpha > 0.9
    depth, spread = surface_depth(g, camera)
    error = [float((d.double() - truth)[solid].abs().mean()) for d in (out.expected_depth, depth)]
    assert error[1] < 2e-3 < 0.02 < error[0]
    assert float(spread[solid].median()) < 5e-3


def test_a_round_gaussian_lies_across_the_ray():
    g = gaussians(torch.tensor([[0.1, -0.2, 0.1]]), [0.05, 0.05, 0.05])
    camera = ring(1, 120, elevations=(30.0,))[0]
    depth, _ = surface_depth(g, camera)
    c = g.means[0].double() @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
    hit = draw(g, camera, 0.0).alpha > 0.05
    expected = (c @ c) / (camera_rays(camera).double() @ c)
    torch.testing.assert_close(depth[hit].double(), expected[hit], atol=1e-3, rtol=0)


def test_two_layers_are_spread():
    layers = torch.rand(400, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    layers[:, 2] = torch.where(layers[:, 2] > 0, 0.1, -0.1)
    camera = ring(1, 120, elevations=(80.0,))[0]
    spread = surface_depth(gaussians(layers, [0.15, 0.15, 1e-3], logit=-2.0), camera)[1]
    middle = spread[50:70, 50:70]
    assert 0.03 < float(middle.median()) < 0.11  # 0.1 where both count alike


def test_planes_are_where_rays_meet_most():
    """Against the depth of greatest density along rays beside the middle, which differs from the plane's in second
    order only."""
    g = torch.Generator().manual_seed(2)
    mean = torch.tensor([[0.3, -0.2, 2.0]], dtype=torch.float64)
    quat = torch.nn.functional.normalize(torch.randn(1, 4, generator=g, dtype=torch.float64), dim=1)
    scales = torch.tensor([[0.3, 0.1, 0.02]], dtype=torch.float64)
    one = GaussianTensors(mean, quat, scales.log(), torch.zeros(1).double(), torch.zeros(1, 1, 3).double())
    eye = torch.tensor([0.1, 0.2, -0.5], dtype=torch.float64)
    n = planes(one.means, one.quats, one.log_scales, eye)[0][0]
    R = so3.quat_to_matrix(quat)[0]
    inverse = R @ torch.diag(scales[0] ** -2) @ R.T
    aside, errors = torch.randn(3, generator=g, dtype=torch.float64), []
    for step in (1e-3, 5e-4):
        ray = mean[0] - eye + step * aside
        densest = (ray @ inverse @ (mean[0] - eye)) / (ray @ inverse @ ray)
        errors.append(abs(float(densest - (mean[0] - eye) @ n / (ray @ n))))
    assert errors[0] < 1e-3 and errors[1] < 0.3 * errors[0] and math.isclose(float(n.norm()), 1.0, rel_tol=1e-12)


def test_nothing_has_no_depth():
    camera = ring(1, 16, elevations=(10.0,))[0]
    depth, spread = surface_depth(gaussians(torch.zeros(0, 3), [1.0, 1.0, 1.0]), camera)
    assert depth.shape == spread.shape == (16, 16) and float(depth.abs().max()) == 0
