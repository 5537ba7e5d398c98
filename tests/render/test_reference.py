"""The reference rasterizer against finite differences and against formulas that can be done by hand."""

import math

import pytest
import torch
from worlds import world

from p2gs.ops.sh import rgb_to_dc
from p2gs.render import rasterize


@pytest.mark.parametrize("antialias", [False, True])
def test_gradcheck(antialias):
    w = world(
        4, 6, 5, bases=4, features=2, background="image", opacity=(0.3, 0.9), scale=(0.3, 0.6), spread=0.3, seed=1
    )
    names = [k for k, t in w.tensors.items() if t is not None]

    def f(*tensors):
        given = dict(zip(names, tensors, strict=True))
        options = {"depth_sq": True, "depth_ref": 2.0, "antialias": antialias, "backend": "torch_ref"}
        out = rasterize(viewmat=w.viewmat, K=w.K, width=6, height=5, **options, **given)
        return out.colour, out.alpha, out.depth, out.depth_sq, out.features

    # a step so small that no alpha crosses 1/255 on the way
    leaves = [w.tensors[k].clone().requires_grad_() for k in names]
    assert torch.autograd.gradcheck(f, leaves, eps=1e-7, atol=1e-5, rtol=1e-4)


def _two_on_the_axis():
    """Two isotropic Gaussians on the optical axis, the far one given first; the image is one pixel on that axis."""
    means = torch.tensor([[0.0, 0, 4], [0, 0, 2]], dtype=torch.float64)
    colours = torch.tensor([[0.2, 0.4, 0.6], [0.9, 0.1, 0.3]], dtype=torch.float64)
    opacities = torch.tensor([0.7, 0.4], dtype=torch.float64)
    K = torch.tensor([[100.0, 0, 0.5], [0, 100, 0.5], [0, 0, 1]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 2).double(), torch.full((2, 3), 0.05, dtype=torch.float64)
    return means, quats, scales, opacities, rgb_to_dc(colours)[:, None], colours, K


def test_two_gaussians_by_hand():
    means, quats, scales, opacities, sh, colours, K = _two_on_the_axis()
    background = torch.tensor([0.0, 1, 0], dtype=torch.float64)
    out = rasterize(
        means,
        quats,
        scales,
        opacities,
        sh,
        torch.eye(4),
        K,
        1,
        1,
        background=background,
        depth_sq=True,
        depth_ref=1.0,
        backend="torch_ref",
    )
    near, far = 0.4, 0.6 * 0.7
    assert torch.allclose(out.colour[0, 0], near * colours[1] + far * colours[0] + (1 - near - far) * background)
    assert math.isclose(out.alpha.item(), near + far, rel_tol=1e-12)
    assert math.isclose(out.depth.item(), near * 2 + far * 4, rel_tol=1e-12)
    assert math.isclose(out.depth_sq.item(), near * 1 + far * 9, rel_tol=1e-12)
    assert out.median_depth.item() == 4  # transmittance 1 -> 0.6 -> 0.18


def test_footprint_by_hand():
    """One isotropic Gaussian: alpha falls off as exp(-r^2 / 2 (f^2 s^2 / z^2 + eps2d)) and ends at 1/255."""
    means, quats, scales, opacities, sh, _, K = (t[1:] if t.shape[0] == 2 else t for t in _two_on_the_axis())
    out = rasterize(means, quats, scales, opacities, sh, torch.eye(4), K, 30, 1, backend="torch_ref")
    variance = (100 * 0.05 / 2) ** 2 + 0.3
    alpha = 0.4 * torch.exp(-0.5 * torch.arange(30, dtype=torch.float64) ** 2 / variance)
    assert torch.allclose(out.alpha[0], torch.where(alpha >= 1 / 255, alpha, 0.0), rtol=1e-12)
    assert (out.alpha[0] == 0).any() and out.radii.item() == math.ceil(math.sqrt(2 * variance * math.log(0.4 * 255)))


@pytest.mark.parametrize("tilt", [0.0, 0.8, 1.3])
def test_antialiased_area(tilt):
    """Opacity falls as the area grows: a disc covers what its projection covers, also when it is seen almost
    edge-on."""
    quats = torch.tensor([[math.cos(tilt / 2), math.sin(tilt / 2), 0, 0]], dtype=torch.float64)
    K = torch.tensor([[200.0, 0, 50.5], [0, 200, 50.5], [0, 0, 1]])
    means, scales, opacity = (
        torch.tensor([[0.0, 0, 4]]).double(),
        torch.tensor([[0.01, 0.01, 1e-5]]).double(),
        torch.tensor([0.9]).double(),
    )
    out = [
        rasterize(
            means,
            quats,
            scales,
            opacity,
            torch.zeros(1, 1, 3),
            torch.eye(4),
            K,
            101,
            101,
            backend="torch_ref",
            **options,
        )
        for options in ({"eps2d": 0.1, "antialias": True}, {"eps2d": 0.3, "antialias": True}, {"eps2d": 0.3})
    ]
    true = 0.9 * 2 * math.pi * (200 * 0.01 / 4) ** 2 * math.cos(tilt)
    sums = [o.alpha.sum().item() for o in out]
    # sampled at pixel centres, cut off at 1/255
    assert sums[0] == pytest.approx(true, rel=0.25) and sums[1] == pytest.approx(true, rel=0.15)
    assert sums[2] > 1.5 * true / max(math.cos(tilt), 0.3)


def test_scaled_and_cropped_cameras():
    """A crop shows the same pixels as the window of the whole image."""
    w = world(200, 60, 44, seed=3, spread=0.15, scale=(0.01, 0.05))
    whole, x = w.render("torch_ref", torch.float64, grad=False)
    K = w.K.clone()
    K[0, 2] -= 13
    K[1, 2] -= 9
    crop = rasterize(viewmat=w.viewmat, K=K, width=25, height=21, backend="torch_ref", **x)
    # small splats near the axis: the Jacobian's clamp, which depends on the window, moves none of those that reach into
    # it much
    assert torch.allclose(whole.colour[9:30, 13:38], crop.colour, atol=1e-3)
    assert (whole.alpha[9:30, 13:38] > 0.5).any()
