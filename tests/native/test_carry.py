"""Rigidly carried Gaussians: the native kernel against torch in float64."""

import pytest
import torch

from p2gs.gaussians.pose import carry as carry_in_torch
from p2gs.gaussians.pose import with_static
from p2gs.ops import se3
from p2gs.ops.carry import Parts, RigidMoves, carry, carry_reference
from p2gs.ops.sh import evaluate
from p2gs.types import GaussianTensors


def setting(n=777, parts=3, degree=3):
    twists = torch.randn(parts, 6) * torch.tensor([1.5] * 3 + [0.5] * 3)
    quats = torch.nn.functional.normalize(torch.randn(n, 4), dim=1)
    sh = torch.randn(n, (degree + 1) ** 2, 3)
    return torch.randn(n, 3), quats, sh, torch.randint(0, parts + 1, (n,)), se3.exp(twists.double())


def assert_follows(means, quats, sh, labels, transforms):
    parts = Parts(labels)
    ours = carry(means, quats, sh, parts, transforms)
    exact = carry_reference(means.double(), quats.double(), sh.double(), parts, transforms)
    for a, b in zip(ours, exact, strict=True):
        assert a.dtype == torch.float32 and a.shape == b.shape and not a.requires_grad
        assert torch.allclose(a.double(), b, atol=2e-6, rtol=2e-6)
    for a, b in zip(ours, (means, quats, sh), strict=True):
        assert torch.equal(a[labels == 0], b[labels == 0])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n, parts", [(0, 2), (1, 1), (15, 1), (16, 2), (777, 3), (5000, 5)])
def test_follows_torch(isa, threads, n, parts, degree):
    assert_follows(*setting(n, parts, degree))


def test_parts_without_gaussians_and_nothing_that_moves(isa):
    means, quats, sh, labels, transforms = setting(300, 4)
    labels[(labels == 1) | (labels == 3)] = 2
    assert_follows(means, quats, sh, labels, transforms)
    assert_follows(means, quats, sh, labels.clamp(0, 2), transforms)  # more motions than parts
    assert_follows(means, quats, sh, labels * 0, transforms)
    assert_follows(means, quats, sh, labels * 0, transforms[:0])


def test_half_turns(isa):
    means, quats, sh, labels, transforms = setting(200, 3)
    for k in range(3):
        transforms[k, :3, :3] = torch.diag(torch.tensor([1.0 if i == k else -1.0 for i in range(3)]))
    assert_follows(means, quats, sh, labels, transforms)


def test_colours_turn_with_the_part(isa):
    means, quats, sh, labels, transforms = setting()
    direction = torch.nn.functional.normalize(torch.randn(len(labels), 3), dim=1)
    R = torch.cat([torch.eye(3)[None], transforms[:, :3, :3].float()])[labels]
    out = carry(means, quats, sh, Parts(labels), transforms)[2]
    assert torch.allclose(evaluate(out, (R @ direction[..., None])[..., 0]), evaluate(sh, direction), atol=1e-5)


def test_inputs_stay_and_results_are_new(isa):
    means, quats, sh, labels, transforms = setting()
    kept = [t.clone() for t in (means, quats, sh)]
    parts = Parts(labels)
    first = [t.clone() for t in carry(means, quats, sh, parts, transforms)]
    again = carry(means, quats, sh, parts, transforms)
    again[0].requires_grad_(True)
    carry(means, quats, sh, parts, transforms.flip(0))
    assert all(torch.equal(a, b) for a, b in zip(kept, (means, quats, sh), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_same_bits_for_any_number_of_threads(isa):
    inputs = setting(20_000)
    answers = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        means, quats, sh, labels, transforms = inputs
        answers.append(carry(means, quats, sh, Parts(labels), transforms))
    assert all(torch.equal(a, b) for other in answers[1:] for a, b in zip(answers[0], other, strict=True))


def test_what_does_not_fit():
    means, quats, sh, labels, transforms = setting()
    with pytest.raises(IndexError, match="part 3"):
        carry(means, quats, sh, Parts(labels), transforms[:2])
    with pytest.raises(ValueError, match="carry wants"):
        carry(means[:-1], quats, sh, Parts(labels), transforms)


@pytest.mark.parametrize("half_turns", [False, True])
def test_moves_with_gradients(isa, half_turns):
    means, quats, sh, labels, transforms = setting(500, 3)
    if half_turns:
        for k in range(3):
            transforms[k, :3, :3] = torch.diag(torch.tensor([1.0 if i == k else -1.0 for i in range(3)]))
    weights = torch.randn(500, 3), torch.randn(500, 4)

    def run(move, dtype):
        leaves = [t.detach().to(dtype).requires_grad_(True) for t in (means, quats)]
        moved = move(*leaves)
        # of q and -q, which turn alike, take the one on the side of a fixed direction
        side = torch.where((moved[1].detach() * weights[1].to(dtype)).sum(1, keepdim=True) < 0, -1.0, 1.0)
        ((moved[0] * weights[0]).sum() + (moved[1] * side * weights[1]).sum()).backward()
        return [moved[0].detach(), moved[1].detach() * side, *(t.grad for t in leaves)]

    def slow(m, q):
        g = carry_in_torch(GaussianTensors(m, q, m, m[:, 0], m[:, None]), labels, with_static(transforms))
        return g.means, g.quats * q.detach().norm(dim=1, keepdim=True)

    ours, exact = run(RigidMoves(labels, transforms), torch.float32), run(slow, torch.float64)
    for a, b in list(zip(ours, exact, strict=True))[:3]:
        assert torch.allclose(a.double(), b, atol=1e-5)
    # the slow way also normalises: compare what is left of the gradient across q
    across = exact[3] - quats * (exact[3] * quats).sum(1, keepdim=True)
    mine = ours[3] - quats * (ours[3] * quats).sum(1, keepdim=True)
    assert torch.allclose(mine.double(), across, atol=1e-5)
