"""Rendering parameters as they are stored: the kernels against the modular path in float64."""

import pytest
import torch
from worlds import backward, relative_error, world

from p2gs.gaussians.draw import render_gaussians
from p2gs.gaussians.splats import Splats
from p2gs.render import RASTERIZERS, rasterize_stored
from p2gs.types import Camera, GaussianTensors

OUTPUTS = ("colour", "alpha", "depth", "depth_sq")


def stored(w, split):
    """A world's tensors as a phase keeps them."""
    t = w.tensors
    sh = {"sh": t["sh"][:, :1], "sh_rest": t["sh"][:, 1:]} if split else {"sh": t["sh"], "sh_rest": None}
    opacity = t["opacities"].clamp(1e-3, 1 - 1e-3)
    return {
        "means": t["means"],
        "quats": t["quats"],
        "log_scales": t["scales"].log(),
        "opacity_logits": opacity.logit(),
        **sh,
    }


def rendered(w, split, backend, dtype, **options):
    given = {k: v if v is None else v.float().to(dtype).clone().requires_grad_() for k, v in stored(w, split).items()}
    out = rasterize_stored(
        **given, viewmat=w.viewmat, K=w.K, width=w.width, height=w.height, backend=backend, depth_sq=True, **options
    )
    return out, {k: v for k, v in given.items() if v is not None}


@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("bases, degree", [(1, 0), (4, 1), (4, 0), (9, 2), (16, 3), (16, 1)])
def test_follows_the_modular_path(isa, split, bases, degree):
    w = world(bases=bases, seed=bases)
    want, x = rendered(w, split, "torch_ref", torch.float64, sh_degree=degree, absgrad=True)
    got, y = rendered(w, split, "cpu", torch.float32, sh_degree=degree, absgrad=True)
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(got, name).double(), getattr(want, name), rtol=1e-4, atol=1e-4)
    want_grads, got_grads = backward(want, x, outputs=OUTPUTS), backward(got, y, outputs=OUTPUTS)
    for name, grad in want_grads.items():
        assert grad.norm() == got_grads[name].norm() or relative_error(got_grads[name], grad) < 3e-5, name
    assert relative_error(got.means2d_abs_grad, want.means2d_abs_grad) < 3e-5


def test_what_is_no_number_is_culled(isa):
    w = world(40, bases=4, seed=1)
    given = {k: v.float() for k, v in stored(w, True).items()}
    broken = [("log_scales", torch.nan), ("log_scales", torch.inf), ("opacity_logits", torch.nan), ("sh", torch.nan)]
    for row, (name, value) in enumerate(broken):
        given[name][row].fill_(value)
    given["sh_rest"][4] = torch.nan
    leaves = {k: v.requires_grad_() for k, v in given.items()}
    out = rasterize_stored(**leaves, viewmat=w.viewmat, K=w.K, width=w.width, height=w.height, backend="cpu")
    assert not out.radii[:5].any() and out.radii.any() and out.colour.isfinite().all()
    for grad in torch.autograd.grad(out.colour.sum() + out.depth.sum(), list(leaves.values())):
        assert grad.isfinite().all() and not grad[:5].any()


def test_backends_of_ones_own_get_scales_and_opacities():
    seen = []

    @RASTERIZERS.register("spy")
    def spy(inputs):
        seen.append(inputs)
        return RASTERIZERS["torch_ref"](inputs)

    try:
        w = world(20, bases=4, seed=2)
        rendered(w, True, "spy", torch.float32)
    finally:
        del RASTERIZERS._items["spy"]
    (inputs,) = seen
    assert not inputs.stored and inputs.sh_rest is None and inputs.sh.shape[1] == 4
    torch.testing.assert_close(inputs.scales, w.tensors["scales"].float())


def test_splats_render_as_their_joined_tensors():
    w = world(200, bases=4, seed=3)
    t = stored(w, False)
    g = GaussianTensors(*(t[n].float() for n in GaussianTensors.NAMES))
    camera = Camera(w.viewmat.float(), w.K.float(), w.width, w.height)
    splats = Splats(g)
    one, other = render_gaussians(splats.tensors(), camera, torch.ones(3)), render_gaussians(g, camera, torch.ones(3))
    assert torch.equal(one.colour, other.colour) and torch.equal(splats.tensors().sh, g.sh)
    moved = splats.tensors().placed(g.means + 1, g.quats)
    assert torch.equal(moved.sh, g.sh) and torch.equal(moved.means, g.means + 1)
