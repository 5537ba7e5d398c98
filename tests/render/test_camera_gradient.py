"""The gradient by world -> camera: the reference against finite differences, the backends against the reference, a
camera found again."""

import pytest
import torch
from test_gsplat_mapping import stand_in_backend
from worlds import backward, relative_error, world

from p2gs.ops import se3
from p2gs.render import rasterize


def rendered(w, backend: str, dtype: torch.dtype, viewmat, **options):
    """Only the camera is a leaf, in ``dtype``."""
    camera = viewmat.to(dtype).clone().requires_grad_()
    leaves = {k: t.to(dtype) for k, t in w.tensors.items() if t is not None}
    return rasterize(viewmat=camera, K=w.K, width=w.width, height=w.height, backend=backend, **leaves, **options), {
        "viewmat": camera
    }


@pytest.mark.parametrize("antialias", [False, True])
def test_gradcheck(antialias):
    w = world(
        4, 6, 5, bases=16, features=2, background="image", opacity=(0.3, 0.9), scale=(0.3, 0.6), spread=0.3, seed=1
    )
    given = {k: t for k, t in w.tensors.items() if t is not None}

    def f(rows):
        viewmat = torch.cat([rows, rows.new_tensor([[0.0, 0, 0, 1]])])
        options = {"depth_sq": True, "depth_ref": 2.0, "antialias": antialias, "backend": "torch_ref"}
        out = rasterize(viewmat=viewmat, K=w.K, width=6, height=5, **options, **given)
        return out.colour, out.alpha, out.depth, out.depth_sq, out.features

    # a step so small that no alpha crosses 1/255 on the way
    assert torch.autograd.gradcheck(f, [w.viewmat[:3].double().requires_grad_()], eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("options", [{}, {"eps2d": 0.1, "antialias": True}, {"sh_degree": 1}, {"near": 2.5}])
def test_native_as_the_reference(isa, options):
    """Of Gaussians that learn too, and of frozen ones; several chunks of them, some behind the camera."""
    w = world(1300, features=3, background="constant", spread=1.2, seed=2)
    options = {"depth_sq": True, "depth_ref": 2.5, **options}
    want = backward(*rendered(w, "torch_ref", torch.float64, w.viewmat, **options))["viewmat"]
    got = backward(*rendered(w, "cpu", torch.float32, w.viewmat, **options))["viewmat"]
    assert relative_error(got[:3], want[:3]) < 2e-5 and got[3].abs().max() == 0


def test_same_bits_for_any_number_of_threads(isa):
    w = world(3000, seed=3, bases=4)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(backward(*rendered(w, "cpu", torch.float32, w.viewmat))["viewmat"])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


def test_wrapper_of_gsplat(monkeypatch):
    """Through the mapping of our arguments onto gsplat's, whose documented behaviour a stand-in has."""
    w = world(60, 40, 30, features=3, background="image", seed=4)
    want = backward(*rendered(w, "torch_ref", torch.float32, w.viewmat, depth_sq=True))["viewmat"]
    with stand_in_backend(monkeypatch) as name:
        got = backward(*rendered(w, name, torch.float32, w.viewmat, depth_sq=True))["viewmat"]
    assert relative_error(got[:3], want[:3]) < 1e-5


def test_a_turned_camera_is_found_again(isa):
    """Descent by the twist of a camera that is 0.3 degrees and 1 % of its distance off."""
    w = world(400, bases=1, opacity=(0.5, 1.0), scale=(0.05, 0.2), seed=5)
    with torch.no_grad():
        photo = rendered(w, "cpu", torch.float32, w.viewmat)[0].colour.detach()
    off = se3.exp(torch.tensor([0.004, -0.003, 0.002, 0.02, -0.01, 0.02]).double())
    guess = off @ w.viewmat.double()
    tensors = {k: t.float() for k, t in w.tensors.items() if t is not None}
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([twist], lr=2e-3)
    for step in range(120):
        optimizer.param_groups[0]["lr"] = 2e-3 * 0.01 ** (step / 120)
        viewmat = (se3.exp(twist) @ guess).float()
        loss = (
            (rasterize(viewmat=viewmat, K=w.K, width=w.width, height=w.height, backend="cpu", **tensors).colour - photo)
            .abs()
            .mean()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    left = se3.log(se3.exp(twist.detach()) @ off)
    assert left.norm() < 0.05 * se3.log(off).norm()
