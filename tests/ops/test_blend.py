"""Soft rigid motion of Gaussians: the native kernel against torch in float64."""

import pytest
import torch

from p2gs.ops import se3
from p2gs.ops.blend import blend_move, blend_move_reference, likeliest, part_motions


def setting(n=777, parts=4, seed=0, turn=1.0):
    g = torch.Generator().manual_seed(seed)
    means, quats = torch.randn(n, 3, generator=g), torch.randn(n, 4, generator=g) * 3
    probs = torch.softmax(2 * torch.randn(n, parts, generator=g), 1)
    twists = torch.randn(parts - 1, 6, generator=g) * torch.tensor([turn] * 3 + [0.5] * 3)
    return [means, quats, probs, twists]


def gradients(f, inputs, dtype):
    leaves = [t.to(dtype).requires_grad_() for t in inputs]
    out = f(*leaves)
    g = torch.Generator().manual_seed(9)
    directions = [torch.randn(o.shape, generator=g).to(dtype) for o in out]
    return [o.detach() for o in out], torch.autograd.grad(out, leaves, directions)


def assert_close(ours, exact):
    for a, b in zip(ours, exact, strict=True):
        assert a.shape == b.shape
        assert (a - b).norm() <= 1e-5 * b.norm() + 1e-12, (a.shape, float((a - b).norm() / b.norm()))


@pytest.mark.parametrize("n", [1, 15, 16, 255, 256, 257, 5000])
@pytest.mark.parametrize("parts", [1, 2, 5])
def test_follows_torch(isa, threads, n, parts):
    inputs = setting(n, parts)
    out, grads = gradients(blend_move, inputs, torch.float32)
    exact, exact_grads = gradients(blend_move_reference, inputs, torch.float64)
    assert_close(out, exact)
    assert_close(grads, exact_grads)


@pytest.mark.parametrize("turn", [0.0, 1e-7, 1e-3, 0.28, 0.3, 0.57, 0.6, 1.7])
def test_turns_of_any_size(turn):
    """Series and closed forms, up to just below a half turn (1.7 sqrt(3) radians)."""
    inputs = setting(300, 3)
    inputs[3][:, :3] = turn * torch.tensor([[1.0, -1.0, 1.0], [1.0, 1.0, 1.0]])
    out, grads = gradients(blend_move, inputs, torch.float32)
    exact, exact_grads = gradients(blend_move_reference, inputs, torch.float64)
    assert_close(out, exact)
    assert_close(grads, exact_grads)


def test_more_than_half_a_turn():
    """Beyond pi the quaternion changes sides; the motion itself does not mind."""
    inputs = setting(300, 2)
    inputs[3][:, :3] = torch.tensor([0.0, 3.6, 0.0])
    out, grads = gradients(blend_move, inputs, torch.float32)
    exact, exact_grads = gradients(blend_move_reference, inputs, torch.float64)
    assert_close(out, exact)
    assert_close(grads, exact_grads)


def test_same_bits_for_any_number_of_threads(isa):
    inputs, results = setting(9001, 6), []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out, grads = gradients(blend_move, inputs, torch.float32)
            results.append([*out, *grads])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_quaternions_without_length_are_the_identity(isa):
    inputs = setting(64, 2)
    inputs[1][::5] = 0
    out, grads = gradients(blend_move, inputs, torch.float32)
    exact, exact_grads = gradients(blend_move_reference, inputs, torch.float64)
    assert_close(out, exact)
    assert_close(grads, exact_grads)
    assert not grads[1][::5].any() and all(t.isfinite().all() for t in (*out, *grads))


def test_one_output_is_enough():
    inputs = [t.requires_grad_() for t in setting(100, 3)]
    moved, turned = blend_move(*inputs)
    a = torch.autograd.grad(moved.sum(), inputs, retain_graph=True)
    b = torch.autograd.grad(turned[:, 1].sum(), inputs)
    assert a[0].any() and not a[1].any() and a[3].any()
    assert not b[0].any() and b[1].any() and b[3][:, :3].any() and not b[3][:, 3:].any()


def test_rows_and_strides_of_any_kind():
    means, quats, probs, twists = setting(50, 3)
    plain = blend_move(means, quats, probs, twists)
    wide = torch.zeros(50, 8)
    wide[:, 1:4] = means
    strided = blend_move(wide[:, 1:4], quats.T.contiguous().T, probs.T.contiguous().T, twists)
    assert all(torch.equal(a, b) for a, b in zip(plain, strided, strict=True))
    assert [t.shape for t in blend_move(*[t[:0] for t in (means, quats, probs)], twists)] == [(0, 3), (0, 4)]


def test_shapes_that_do_not_fit():
    means, quats, probs, twists = setting(10, 3)
    with pytest.raises(ValueError, match="blend_move wants"):
        blend_move(means, quats, probs, twists[:1])


@pytest.mark.parametrize("turn", [0.0, 1e-4, 0.2, 0.29, 1.0, 3.6])
def test_motions_of_twists(turn):
    twists = setting(1, 4, turn=turn)[3]
    if turn:
        twists[:, :3] *= turn / twists[:, :3].norm(dim=1, keepdim=True)
    direction = torch.randn(4, 4, 4, generator=torch.Generator().manual_seed(1))
    a, b = twists.clone().requires_grad_(), twists.double().requires_grad_()
    ours, exact = part_motions(a), torch.cat([torch.eye(4).double()[None], se3.exp(b)])
    assert_close([ours.detach()], [exact.detach()])
    assert_close(torch.autograd.grad(ours, a, direction), torch.autograd.grad(exact, b, direction.double()))


def test_likeliest_is_argmax_and_takes_the_first_of_equals():
    probs = torch.randint(0, 3, (1000, 4), generator=torch.Generator().manual_seed(0)).float()
    first = torch.tensor([row.index(max(row)) for row in probs.tolist()])
    assert torch.equal(likeliest(probs), first) and torch.equal(likeliest(probs.T.contiguous().T), first)
    assert torch.equal(likeliest(probs[:, :1]), torch.zeros(1000, dtype=torch.int64))
