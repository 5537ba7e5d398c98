"""Motion richness, beta, matching and fusion against literal twins."""

import math

import pytest
import torch
from tiny import random_gaussians

from p2gs.gaussians.handover import PartMotions
from p2gs.gaussians.pose import carry, with_static
from p2gs.models.canonical import CanonicalConfig, blend, fuse
from p2gs.motion.matching import beta_weight, farthest_points, hungarian_pairs, motion_clusters, motion_richness
from p2gs.ops import se3
from p2gs.types import GaussianTensors, UserError


def cloud(n, seed):
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


def test_motion_richness_is_the_mean_unsquared_nearest_distance():
    a, b = cloud(40, 0), cloud(30, 1)
    literal = sum(min(float((x - y).norm()) for y in b) for x in a) / len(a)
    assert math.isclose(motion_richness(a, b), literal, rel_tol=1e-5)


def test_trim_leaves_out_floaters():
    a, b = cloud(100, 0), cloud(100, 0)
    a = torch.cat([a, torch.tensor([[50.0, 0, 0]])])
    assert motion_richness(a, b, 0.02) < 1e-3 < motion_richness(a, b)


def test_beta():
    assert beta_weight(1.0, 3.0) == 0.25
    assert beta_weight(0.0, 0.0) == 0.5


def test_farthest_points_against_the_slow_way():
    points = cloud(60, 2)
    picked = [int((points - points.mean(0)).square().sum(1).argmin())]
    while len(picked) < 12:
        gaps = torch.stack([(points - points[i]).square().sum(1) for i in picked]).amin(0)
        picked.append(int(gaps.argmax()))
    assert farthest_points(points, 12).tolist() == picked
    assert farthest_points(points, 100).tolist() == list(range(60))


def test_hungarian_pairs_undo_a_small_shift():
    a = cloud(50, 3)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    b = a[order] + 0.001
    i, j = hungarian_pairs(a, b, 50)
    assert torch.equal(order[j], i)


def test_blend_takes_quaternions_from_one_hemisphere():
    a = random_gaussians(5)
    b = GaussianTensors(a.means + 1, -a.quats, a.log_scales, a.opacity_logits, a.sh)
    mixed = blend(a, b, 0.25)
    assert torch.allclose(mixed.means, a.means + 0.75)
    assert torch.allclose(mixed.quats, torch.nn.functional.normalize(a.quats, dim=1), atol=1e-6)


def door_and_wall(angle=0.9, n=400):
    """Two states of a wall (part 0) and a door (part 1) that turned about z."""
    gen = torch.Generator().manual_seed(5)
    wall = torch.stack([torch.rand(n, generator=gen) - 1.2, torch.zeros(n), torch.rand(n, generator=gen)], 1)
    door = torch.stack([torch.rand(n, generator=gen), torch.zeros(n), torch.rand(n, generator=gen)], 1)
    T = se3.from_screw(torch.tensor([0.0, 0, 1]).double(), torch.zeros(3).double(), angle)
    labels = torch.cat([torch.zeros(n), torch.ones(n)]).long()

    def gaussians(points):
        g = random_gaussians(2 * n)
        return GaussianTensors(points, g.quats, g.log_scales, torch.full((2 * n,), 3.0), g.sh)

    g0 = gaussians(torch.cat([wall, door]))
    g1 = gaussians(torch.cat([wall, se3.apply(T.float(), door)]))
    motions = PartMotions(["revolute"], T[None], torch.ones(1), [labels, labels], [torch.ones(2 * n)] * 2)
    return g0, g1, motions


@pytest.mark.parametrize("beta", ["global", "uniform", "per_part"])
@pytest.mark.parametrize("fusion", ["union", "paper"])
def test_fused_gaussians_meet_both_states_along_the_screw(beta, fusion):
    g0, g1, motions = door_and_wall()
    fused = fuse(g0, g1, motions, CanonicalConfig(beta=beta, fusion=fusion, match_size=800))
    T = with_static(motions.transforms)
    for state, truth in ((0, g0), (1, g1)):
        posed = carry(fused.gaussians, fused.labels, se3.screw_at(T, state - fused.canonical_times))
        distance = torch.cdist(posed.means, truth.means).amin(1)
        assert distance.max() < 0.03
    moved = torch.cdist(
        se3.apply(motions.transforms[0].float(), fused.mu0[fused.paired & (fused.labels == 1)]),
        fused.mu1[fused.paired & (fused.labels == 1)],
    )
    assert moved.diagonal().median() < 0.1
    assert int(fused.paired.sum()) > 100


def test_of_the_poorer_state_only_what_the_richer_one_hides_is_added():
    g0, g1, motions = door_and_wall()
    lone = torch.arange(len(g0)) < 20
    # twenty of each state have no counterpart
    shift = torch.where(lone[:, None], torch.tensor([0.0, -0.5, 0.0]), torch.zeros(3))
    a, b = (
        GaussianTensors(g.means + shift * (1 + s), g.quats, g.log_scales, g.opacity_logits, g.sh)
        for s, g in enumerate((g0, g1))
    )
    plain = fuse(a, b, motions, CanonicalConfig())
    shares = torch.full((len(g0),), 0.5)
    none = fuse(a, b, motions, CanonicalConfig(), (shares, shares))
    some = fuse(a, b, motions, CanonicalConfig(), (torch.where(lone, 0.9, shares),) * 2)
    assert len(none.gaussians) == len(g0) and len(plain.gaussians) == len(g0) + 20
    assert len(some.gaussians) == len(plain.gaussians)


def test_the_papers_letter_keeps_the_chords():
    g0, g1, motions = door_and_wall()
    fused = fuse(g0, g1, None, CanonicalConfig(beta="global", match_size=500))
    n = int(fused.paired.sum())
    assert n == 500 and fused.offsets is not None
    beta = float(fused.betas[0])
    middle = beta * fused.mu0[:n] + (1 - beta) * fused.mu1[:n]
    assert torch.allclose(fused.gaussians.means[:n], middle, atol=1e-5)
    assert torch.allclose(fused.gaussians.means[:n] + fused.offsets[:n, 1], fused.mu1[:n], atol=1e-5)
    with pytest.raises(UserError, match="per_part needs discovered parts"):
        fuse(g0, g1, None, CanonicalConfig(beta="per_part"))


def test_nothing_reconstructed_is_told():
    g = random_gaussians(20)
    g.opacity_logits[:] = -5
    with pytest.raises(UserError, match="Gaussians of a state are opaque"):
        fuse(g, g, None, CanonicalConfig())


def test_the_smaller_set_is_matched_whole():
    generator = torch.Generator().manual_seed(3)
    a, b = torch.rand(70, 3, generator=generator), torch.rand(200, 3, generator=generator)
    for first, second in ((a, b), (b, a)):
        i, j = hungarian_pairs(first, second, 90, smaller_whole=True)
        small = i if len(first) < len(second) else j
        assert sorted(small.tolist()) == list(range(70)) and len(set((j if small is i else i).tolist())) == 70
    i, j = hungarian_pairs(a, b, 30, smaller_whole=True)
    assert len(i) == 30  # 70 against 30 of the larger
    assert len(hungarian_pairs(a, a + 0.001, 30, smaller_whole=True)[0]) == 30


def test_motion_clusters_are_what_moves_alike():
    generator = torch.Generator().manual_seed(3)
    start = torch.cat([torch.rand(50, 3, generator=generator) + shift for shift in (0.0, 5.0, 10.0)])
    end = start.clone()
    end[50:100, 0] += 1.0
    end[100:, 1] += 1.0
    labels = motion_clusters(start, end, 2)
    assert not labels[:50].any() and len(set(labels[50:100].tolist())) == len(set(labels[100:].tolist())) == 1
    assert labels[50] != labels[100] and labels[50] > 0 and labels[100] > 0
    assert not motion_clusters(start, start, 2).any()
