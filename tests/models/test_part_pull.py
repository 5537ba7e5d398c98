"""How Gaussians pull at their parts: native code against torch in float64."""

import pytest
import torch

from p2gs.motion.part_pull import by_inverse, part_pulls, part_pulls_reference
from p2gs.native import native, why_missing
from p2gs.ops import se3, so3
from p2gs.ops.carry import Parts

pytestmark = pytest.mark.skipif(native is None, reason=str(why_missing))


def setting(n, dtype=torch.float32):
    g = torch.Generator().manual_seed(n)
    means, quats, a, b, seen = (torch.randn(n, k, generator=g).to(dtype) for k in (3, 4, 3, 4, 3))
    quats = torch.nn.functional.normalize(quats, dim=1)
    means.grad, quats.grad = a, b
    labels = torch.randint(0, 4, (n,), generator=g)
    labels[labels == 2] = 0  # a part without Gaussians
    turns = so3.rotvec_to_matrix(torch.randn(3, 3, generator=g).double())
    return (
        means,
        quats,
        Parts(labels),
        torch.randn(3, 3, generator=g).double(),
        (seen, turns, torch.tensor([0.3, 2.0, -1.0]), 0.2),
    )


@pytest.mark.parametrize("n", [0, 1, 40, 3000])
@pytest.mark.parametrize("limited", [False, True])
def test_follows_torch(n, limited):
    means, quats, parts, centres, limit = setting(n)
    ours = part_pulls(means, quats, parts, centres, limit if limited else None)
    exact = setting(n)
    wide = [t.double() for t in exact[:2]]
    for t, narrow in zip(wide, exact[:2], strict=True):
        t.grad = narrow.grad.double()
    seen, turns, eye, least = limit
    want = part_pulls_reference(*wide, parts, centres, (seen.double(), turns, eye.double(), least) if limited else None)
    assert ours.dtype == want.dtype == torch.float64 and ours.shape == (3, 6)
    assert torch.allclose(ours, want, atol=1e-5) and not ours[1].any()
    if limited and n > 1000:
        assert not torch.allclose(ours, part_pulls(means, quats, parts, centres), atol=0.1)


def test_pulls_at_inverse_motions_are_the_gradient_by_the_motions():
    torch.manual_seed(5)
    there, weights, centres = torch.randn(40, 3).double(), torch.randn(40, 3).double(), torch.randn(2, 3).double()
    labels, T = torch.randint(0, 3, (40,)), se3.exp(torch.randn(2, 6).double())

    def loss(small):
        about = se3.apply(T, centres[:, None])[:, 0]
        to, back = (se3.make(torch.eye(3).double(), x) for x in (about, -about))
        moves = se3.inverse(to @ se3.exp(small) @ back @ T)
        return sum((se3.apply(moves[k], there) * weights)[labels == k + 1].sum() for k in (0, 1))

    steps = torch.eye(12).double().reshape(12, 2, 6) * 1e-6
    want = torch.stack([(loss(s) - loss(-s)) / 2e-6 for s in steps]).reshape(2, 6)
    quats = torch.zeros(40, 4).double()
    here = torch.where(labels[:, None] == 1, *se3.apply(se3.inverse(T), there))
    here.grad, quats.grad = weights, torch.zeros(40, 4).double()
    torch.testing.assert_close(
        by_inverse(part_pulls_reference(here, quats, Parts(labels), centres), T), want, atol=1e-6, rtol=0
    )
