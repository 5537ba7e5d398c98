"""Soft part assignment: the native kernel against torch in float64."""

import pytest
import torch

from p2gs.ops.assign import soft_assignment, soft_assignment_reference


def setting(n=777, dim=16, parts=5, spread=1.0):
    g = torch.Generator().manual_seed(0)
    return [
        spread * torch.randn(n, dim, generator=g),
        torch.randn(parts, dim, generator=g),
        torch.randn(parts, generator=g),
    ]


def gradients(f, inputs, dtype, temperature):
    leaves = [t.to(dtype).requires_grad_() for t in inputs]
    out = f(*leaves, temperature)
    direction = torch.randn(out.shape, generator=torch.Generator().manual_seed(9)).to(dtype)
    return [out.detach(), *torch.autograd.grad(out, leaves, direction)]


@pytest.mark.parametrize("n", [1, 15, 17, 511, 512, 513, 3000])
@pytest.mark.parametrize("dim, parts", [(16, 5), (16, 2), (16, 8), (32, 3), (1, 1), (3, 2), (17, 9), (64, 32)])
def test_follows_torch(isa, threads, n, dim, parts):
    inputs = setting(n, dim, parts)
    ours = gradients(soft_assignment, inputs, torch.float32, 0.7)
    exact = gradients(soft_assignment_reference, inputs, torch.float64, 0.7)
    for a, b in zip(ours, exact, strict=True):
        assert a.shape == b.shape
        assert (a - b).norm() <= 1e-5 * b.norm() + 1e-6, (a.shape, float((a - b).norm() / b.norm()))


def test_hard_assignments_stay_finite(isa):
    """A low temperature leaves all but one part nothing at all."""
    inputs = setting(1000, spread=30.0)
    probs, *grads = gradients(soft_assignment, inputs, torch.float32, 0.01)
    torch.testing.assert_close(probs.sum(1), torch.ones(1000))
    assert all(t.isfinite().all() for t in (probs, *grads))
    assert torch.equal(probs.argmax(1), soft_assignment_reference(*inputs).argmax(1))


def test_same_bits_for_any_number_of_threads(isa):
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(gradients(soft_assignment, setting(9001, 16, 6), torch.float32, 0.5))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_gradients_of_the_reference():
    inputs = [t.double().requires_grad_() for t in setting(6, 4, 3)]
    assert torch.autograd.gradcheck(lambda *x: soft_assignment(*x, 0.6), inputs)


def test_sizes_beyond_the_kernel_and_shapes_that_do_not_fit():
    wide = setting(20, 65, 3)
    assert torch.equal(soft_assignment(*wide), soft_assignment_reference(*wide))
    psi, weight, bias = setting(20)
    assert soft_assignment(psi[:0], weight, bias).shape == (0, 5)
    assert torch.equal(soft_assignment(psi.T.contiguous().T, weight, bias), soft_assignment(psi, weight, bias))
    with pytest.raises(ValueError, match="soft_assignment wants"):
        soft_assignment(psi, weight[:, :3], bias)
