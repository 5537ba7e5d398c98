"""Our arguments onto gsplat's and its results back, with a stand-in for gsplat that has its documented behaviour (no
CUDA needed)."""

import importlib
import sys
import types
from contextlib import contextmanager

import torch
from worlds import OUTPUTS, backward, relative_error, world

from p2gs.ops.sh import evaluate
from p2gs.render import base


def _rasterization(
    *,
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    near_plane,
    far_plane,
    eps2d,
    packed,
    absgrad,
    rasterize_mode,
):
    """gsplat.rasterization for one camera and post-activation colours of any number of channels, by way of the torch
    reference."""
    from p2gs.render.torch_ref import rasterize_torch

    assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3) and not packed and far_plane == 1e10
    n = means.shape[0]
    inputs = base.RenderInputs(
        means,
        quats,
        scales,
        opacities,
        torch.zeros(n, 1, 3),
        viewmats[0],
        Ks[0],
        width,
        height,
        0,
        colors,
        None,
        False,
        0.0,
        near_plane,
        eps2d,
        {"classic": False, "antialiased": True}[rasterize_mode],
        False,
        False,
    )
    out = rasterize_torch(inputs)
    # means2d takes part in the graph, so that its hook runs; gsplat fills `absgrad` before it does
    means2d = means[None, :, :2] * 1.0
    means2d.absgrad = torch.tensor([[[3.0, 4.0]]]).expand(1, n, 2)
    image = out.features + 0 * means2d.sum()
    return (
        image[None],
        out.alpha[None, ..., None],
        {"radii": out.radii[None, :, None].expand(1, n, 2), "means2d": means2d},
    )


def _spherical_harmonics(degrees_to_use, dirs, coeffs):
    """gsplat.spherical_harmonics: without the constant half, of directions of any length."""
    assert coeffs.shape[-2] >= (degrees_to_use + 1) ** 2
    return evaluate(coeffs, torch.nn.functional.normalize(dirs, dim=-1), degrees_to_use) - 0.5


@contextmanager
def stand_in_backend(monkeypatch):
    """Within it gsplat is the stand-in; gives the name of the backend that goes through it."""
    stand_in = types.ModuleType("gsplat")
    stand_in.rasterization, stand_in.spherical_harmonics = _rasterization, _spherical_harmonics
    monkeypatch.setitem(sys.modules, "gsplat", stand_in)
    monkeypatch.setattr(base.RASTERIZERS, "_items", dict(base.RASTERIZERS._items))
    monkeypatch.delitem(sys.modules, "p2gs.render.gsplat", raising=False)
    backend = importlib.import_module("p2gs.render.gsplat")
    base.RASTERIZERS._items["stand_in"] = backend.through_gsplat
    yield "stand_in"
    monkeypatch.delitem(sys.modules, "p2gs.render.gsplat")


def test_same_as_the_reference(monkeypatch):
    with stand_in_backend(monkeypatch) as name:
        _compare(name)


def _compare(name: str) -> None:
    for options in ({}, {"depth_sq": True, "depth_ref": 2.5}, {"eps2d": 0.1, "antialias": True}):
        w = world(60, 40, 30, features=3, background="image", seed=4)
        w.tensors["means"][5, 1] = torch.nan
        w.tensors["sh"][6, 2, 0] = torch.inf
        want, x = w.render("torch_ref", torch.float32, **options)
        got, y = w.render(name, torch.float32, absgrad=True, **options)
        for output in OUTPUTS:
            if getattr(want, output) is not None:
                assert relative_error(getattr(got, output), getattr(want, output)) < 1e-5, output
        assert torch.equal(want.radii, got.radii)
        want, gradients = backward(want, x), backward(got, y)
        for leaf in want:
            assert gradients[leaf].isfinite().all()
            assert relative_error(gradients[leaf], want[leaf]) < 1e-5, leaf
        assert torch.equal(got.means2d_abs_grad, torch.full((60,), 5.0))
