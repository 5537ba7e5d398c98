"""gsplat itself, on a CUDA device, against the torch reference in float64: images, gradients, edge cases."""

import pytest
import torch
from worlds import OUTPUTS, backward, relative_error, world

from p2gs.render import rasterize
from p2gs.types import UserError

pytest.importorskip("gsplat")
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

# gsplat is built with fast arithmetic; where a Gaussian fades below 1/255 a pixel may count it on one side alone
IMAGES, GRADIENTS = 2e-3, 1e-2


def _on_cuda(w):
    for name, t in w.tensors.items():
        w.tensors[name] = None if t is None else t.cuda()
    return w


@pytest.mark.parametrize("options", [{}, {"depth_sq": True, "depth_ref": 2.5}, {"eps2d": 0.1, "antialias": True}])
@pytest.mark.parametrize("bases, features", [(1, 0), (16, 3), (4, 16)])
def test_same_as_the_reference(options, bases, features):
    background = "image" if features else "constant"
    # opacities below the reference's cap of 0.99: gsplat's is 0.999
    w = _on_cuda(world(400, 96, 80, bases=bases, features=features, background=background, opacity=(0.05, 0.98)))
    want, x = w.render("torch_ref", torch.float64, absgrad=True, **options)
    got, y = w.render("gsplat", torch.float32, absgrad=True, **options)
    for output in OUTPUTS:
        if getattr(want, output) is not None:
            assert relative_error(getattr(got, output), getattr(want, output)) < IMAGES, output
    want_grads, got_grads = backward(want, x), backward(got, y)
    for leaf in want_grads:
        assert relative_error(got_grads[leaf], want_grads[leaf]) < GRADIENTS, leaf
    assert relative_error(got.means2d_abs_grad, want.means2d_abs_grad) < GRADIENTS


def test_camera_gradient():
    w = _on_cuda(world(300, 64, 48, bases=4, opacity=(0.05, 0.9)))
    gradients = []
    for backend, dtype in (("torch_ref", torch.float64), ("gsplat", torch.float32)):
        viewmat = w.viewmat.to("cuda", dtype).requires_grad_()
        leaves = {k: t.to(dtype) for k, t in w.tensors.items() if t is not None}
        out = rasterize(viewmat=viewmat, K=w.K, width=w.width, height=w.height, backend=backend, **leaves)
        ramp = torch.linspace(0, 1, w.width, device="cuda", dtype=dtype)
        (out.colour * ramp[None, :, None]).sum().backward()
        gradients.append(viewmat.grad)
    assert relative_error(gradients[1], gradients[0]) < GRADIENTS


def test_not_finite_and_empty():
    w = _on_cuda(world(60, 40, 30, features=3))
    w.tensors["means"][5, 1] = torch.nan
    w.tensors["sh"][6, 2, 0] = torch.inf
    out, leaves = w.render("gsplat", torch.float32)
    assert all(g.isfinite().all() for g in backward(out, leaves).values())
    assert out.radii[5] == 0 and out.radii[6] == 0
    for name in ("means", "quats", "scales", "opacities", "sh", "features"):
        w.tensors[name] = w.tensors[name][:0]
    out, _ = w.render("gsplat", torch.float32)
    assert out.alpha.abs().max() == 0


def test_tensors_of_the_cpu_are_refused():
    w = world(10, 20, 20, bases=1)
    with pytest.raises(UserError, match="CUDA"):
        w.render("gsplat", torch.float32)
