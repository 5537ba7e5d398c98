"""Sums over pixels: the native passes against torch in float64."""

import pytest
import torch
import torch.nn.functional as F

from p2gs.ops.pixels import clamped_cross_entropy, compose, depth_spread


def image(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def value_and_gradients(f, leaves):
    leaves = [t.clone().requires_grad_() for t in leaves]
    out = f(*leaves)
    return out.detach(), torch.autograd.grad(3 * out, leaves)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (64, 64), (131, 177)])
def test_cross_entropy_follows_torch(isa, threads, shape):
    pred, target = image(*shape), (image(*shape, seed=1) * 1.4 - 0.2).clamp(0, 1)
    pred.flatten()[::7] = 0
    pred.flatten()[1::7] = 1  # clamped: no gradient
    ours, (grad,) = value_and_gradients(lambda p: clamped_cross_entropy(p, target, 1e-4), [pred])
    eps = float(torch.tensor(1e-4))
    exact, (true,) = value_and_gradients(
        lambda p: F.binary_cross_entropy(p.clamp(eps, 1 - eps), target.double()), [pred.double()]
    )
    assert abs(ours - exact) <= 1e-5 * exact
    torch.testing.assert_close(grad.double(), true, rtol=1e-4, atol=1e-9)
    assert not grad.flatten()[::7].any()


@pytest.mark.parametrize("knee", [None, 0.02])
@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (131, 177)])
def test_depth_spread_follows_torch(isa, threads, shape, knee):
    alpha = image(*shape)
    depth = alpha * (2 + 0.1 * image(*shape, seed=1))
    square = alpha * (0.1 * image(*shape, seed=2)) ** 2
    target = image(*shape, seed=3)
    leaves = [alpha, depth, square]
    ours, grads = value_and_gradients(lambda *x: depth_spread(*x, target, 2.0, knee), leaves)
    exact, true = value_and_gradients(
        lambda *x: depth_spread(*x, target.double(), 2.0, knee), [t.double() for t in leaves]
    )
    torch.testing.assert_close(ours.double(), exact, rtol=1e-4, atol=1e-8)
    for a, b in zip(grads, true, strict=True):
        assert (a - b).norm() <= 1e-5 * b.norm()


def test_same_bits_for_any_number_of_threads(isa):
    alpha, target, results = image(401, 397), image(401, 397, seed=1), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        a, b = value_and_gradients(lambda p: clamped_cross_entropy(p, target, 1e-4), [alpha])
        c, d = value_and_gradients(lambda x: depth_spread(x, x.detach() * 2, x.detach(), target, 2.0), [alpha])
        results.append([a, *b, c, *d])
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


def test_nothing_inside_is_zero():
    zero = depth_spread(*[image(4, 4, seed=s).requires_grad_() for s in range(3)], torch.zeros(4, 4), 1.0)
    assert zero == 0 and zero.requires_grad


def test_the_clamp_may_be_left_out():
    """Without eps the logarithms need torch's own floor."""
    pred, target = torch.tensor([0.0, 1.0, 0.5]), torch.tensor([1.0, 0.0, 0.5])
    torch.testing.assert_close(clamped_cross_entropy(pred, target, 0.0), F.binary_cross_entropy(pred, target))


@pytest.mark.parametrize("shape", [(1, 1), (7, 9), (130, 150)])
def test_compose_follows_torch(isa, threads, shape):
    g = torch.Generator().manual_seed(0)
    alpha8 = torch.randint(0, 256, shape, generator=g, dtype=torch.uint8)
    colour = (torch.rand(*shape, 3, generator=g) * alpha8[..., None]).to(torch.uint8)
    background = torch.tensor([0.2, 0.5, 1.0])
    ours, alpha = compose(colour, alpha8, background)
    torch.testing.assert_close(alpha, alpha8.float() / 255)
    torch.testing.assert_close(ours, colour.float() / 255 + (1 - alpha[..., None]) * background)


def test_shapes_that_differ():
    with pytest.raises(ValueError, match="one shape"):
        clamped_cross_entropy(torch.rand(3, 4), torch.rand(4, 3), 1e-4)
    with pytest.raises(ValueError, match="one shape"):
        depth_spread(torch.rand(3), torch.rand(3), torch.rand(3), torch.rand(4), 1.0)
