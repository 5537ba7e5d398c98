"""Bends of hidden surfaces: the native kernel against torch in float64."""

import pytest
import torch

from p2gs.ops.planar import hidden_bends, hidden_bends_reference

OPTIONS = ((1, 3, 9), 0.1, 0.01)


def pictures(h, w, seed=0):
    """Photograph, its alpha, rendered depth and alpha: a wavy disc with stripes."""
    g = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(h).float(), torch.arange(w).float(), indexing="ij")
    covers = ((x - w / 2) ** 2 + (y - h / 2) ** 2 < (0.45 * max(h, w)) ** 2).float()
    alpha = covers * (0.9 + 0.1 * torch.rand(h, w, generator=g)) + 0.2 * (1 - covers)
    depth = 2 + 0.3 * torch.sin(x / 9) + 0.05 * torch.rand(h, w, generator=g)
    image = 0.5 + 0.2 * torch.sin(y / 11)[..., None] + 0.02 * torch.rand(h, w, 3, generator=g)
    image[:, (x[0] // 16 % 2) == 0] *= 0.6
    return image, covers, depth * alpha, alpha


def value_and_gradients(f, image, covers, depth, alpha, options=OPTIONS):
    leaves = [t.clone().requires_grad_() for t in (depth, alpha)]
    out = f(image, covers, *leaves, *options)
    return out.detach(), torch.autograd.grad(3 * out, leaves)


@pytest.mark.parametrize("shape", [(3, 4), (19, 7), (5, 70), (64, 64), (57, 83)])
def test_kernel_follows_torch(isa, threads, shape):
    given = pictures(*shape)
    ours, grads = value_and_gradients(hidden_bends, *given)
    exact, true = value_and_gradients(hidden_bends_reference, *(t.double() for t in given))
    assert abs(ours - exact) <= 1e-5 * exact and exact > 0
    for a, b in zip(grads, true, strict=True):
        assert (a - b).norm() <= 1e-4 * b.norm()


def test_same_bits_for_any_number_of_threads(isa):
    given, results = pictures(150, 133), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        value, grads = value_and_gradients(hidden_bends, *given)
        results.append([value, *grads])
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


def test_reference_gradient():
    image, covers, depth, alpha = (t.double() for t in pictures(9, 11))
    # the factor d^2 of a bend has no gradient: depth stays where it is and another one bends
    flat = torch.full_like(depth, 1.0)
    ones = torch.ones_like(flat)
    moved = (flat + 1e-7 * depth).requires_grad_()
    (grad,) = torch.autograd.grad(hidden_bends_reference(image, covers, moved, ones, *OPTIONS), moved)
    for i, j in ((4, 5), (3, 7), (5, 2)):
        step = torch.zeros_like(flat)
        step[i, j] = 1e-10
        ends = [hidden_bends_reference(image, covers, moved.detach() + s * step, ones, *OPTIONS) for s in (1, -1)]
        assert (ends[0] - ends[1]) / 2e-10 == pytest.approx(grad[i, j].item(), rel=1e-3, abs=1e-6)


def test_thin_and_deep_pixels():
    image, covers, depth, alpha = pictures(40, 40)
    alpha[10:14] = 0.4  # a hole
    depth[20:24] = 1e-5  # nearer than what counts: clamped, without gradient
    ours, (by_depth, by_alpha) = value_and_gradients(hidden_bends, image, covers, depth, alpha)
    exact, (true, _) = value_and_gradients(hidden_bends_reference, *(t.double() for t in (image, covers, depth, alpha)))
    assert abs(ours - exact) <= 1e-4 * exact
    assert not by_depth[10:14].any() and not by_alpha[10:14].any() and not by_depth[20:24].any()
    assert (by_depth - true).norm() <= 1e-3 * true.norm()


def test_no_stride_fits():
    assert hidden_bends(*pictures(4, 5), (3, 9), 0.1, 0.01) is None
    with pytest.raises(ValueError, match="hidden_bends wants"):
        hidden_bends(torch.zeros(4, 4, 3), torch.zeros(4, 4), torch.zeros(4, 5), torch.zeros(4, 4), (1,), 0.1, 0.01)
