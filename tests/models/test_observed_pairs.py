"""Pairs kept between steps: what they say of rotations, and when they are stale."""

import torch

from p2gs.models.observed_pairs import ObservedPairs
from p2gs.ops import so3


def setting(n=2000, parts=4):
    g = torch.Generator().manual_seed(0)
    paired = torch.rand(n, generator=g) > 0.3
    mu0 = torch.randn(n, 3, generator=g) * 0.1 + torch.tensor([0.5, -0.8, 0.3])
    turn = so3.rotvec_to_matrix(torch.tensor([0.3, -0.5, 0.9]))
    mu1 = mu0 @ turn.T + 0.01 * torch.randn(n, 3, generator=g)
    mu0[~paired] = 9.0  # what they hold without a pair must not matter
    return paired, mu0, mu1, torch.softmax(3 * torch.randn(n, parts, generator=g), 1)


def test_rotations_are_those_of_kabsch():
    paired, mu0, mu1, probs = setting()
    pairs = ObservedPairs(paired, mu0, mu1)
    assert (
        torch.equal(pairs.index, paired.nonzero()[:, 0])
        and torch.equal(pairs.mu0, mu0[paired])
        and torch.equal(pairs.mu1, mu1[paired])
    )
    expected, _ = so3.kabsch(mu0[paired].double(), mu1[paired].double(), probs[paired].T.double() + 1e-9)
    torch.testing.assert_close(pairs.rotations(probs).double(), expected, rtol=0, atol=1e-6)


def test_a_part_without_mass_follows_the_whole():
    paired, mu0, mu1, probs = setting(parts=3)
    probs = torch.cat([probs, torch.zeros(len(probs), 1)], 1)
    whole, _ = so3.kabsch(mu0[paired].double(), mu1[paired].double())
    torch.testing.assert_close(ObservedPairs(paired, mu0, mu1).rotations(probs)[3].double(), whole, rtol=0, atol=1e-5)


def test_changed_pairs_are_noticed():
    paired, mu0, mu1, _ = setting(50)
    pairs = ObservedPairs(paired, mu0, mu1)
    assert pairs.are_of(paired, mu0, mu1) and not pairs.are_of(paired, mu0.clone(), mu1)
    mu1[0] += 1
    assert not pairs.are_of(paired, mu0, mu1)
