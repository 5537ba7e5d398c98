"""What of two reconstructions corresponds, and how much moved: motion richness D, beta, Hungarian pairs (paper section
4.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.ops.knn import knn

STILL = 0.02  # share of the largest squared motion below which a pair counts as still: ArtGS's rule for its dynamic set


def motion_richness(a: Tensor, b: Tensor, trim: float = 0.0) -> float:
    """D^{a->b} = E_i min_j ||a_i - b_j|| (paper Eq. D, unsquared), the largest ``trim`` of the distances left out. a
    [N, 3], b [M, 3]."""
    distance = knn(b, a, 1, False)[0][:, 0]
    keep = max(int(round(len(distance) * (1 - trim))), 1)
    return float(distance.sort().values[:keep].mean())


def beta_weight(d01: float, d10: float) -> float:
    """beta = D01 / (D01 + D10); 0.5 when nothing moved."""
    return d01 / (d01 + d10) if d01 + d10 > 0 else 0.5


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Indices [min(count, N)] of farthest-point sampling, started at the point nearest the mean (deterministic)."""
    n = len(points)
    if count >= n:
        return torch.arange(n)
    picked = torch.empty(count, dtype=torch.int64)
    picked[0] = (points - points.mean(0)).square().sum(1).argmin()
    columns = points.T.contiguous()
    nearest = torch.full((n,), float("inf"))
    for i in range(1, count):
        last = columns[:, picked[i - 1]]
        distance = (
            (columns[0] - last[0])
            .square_()
            .add_((columns[1] - last[1]).square_())
            .add_((columns[2] - last[2]).square_())
        )
        torch.minimum(nearest, distance, out=nearest)
        picked[i] = nearest.argmax()
    return picked


def hungarian_pairs(a: Tensor, b: Tensor, count: int, smaller_whole: bool = False) -> tuple[Tensor, Tensor]:
    """Match farthest points of a [N, 3] and b [M, 3] by least total distance (paper section 4.1). Returns indices (into
    a, into b).

    count: farthest points of each that are matched; with ``smaller_whole`` of the larger set only, every point of the
    smaller one is.
    """
    from scipy.optimize import linear_sum_assignment

    if smaller_whole:
        keep_a, keep_b = (len(a), count) if len(a) <= len(b) else (count, len(b))
    else:
        keep_a = keep_b = min(count, len(a), len(b))
    ia, ib = farthest_points(a, keep_a), farthest_points(b, keep_b)
    rows, cols = linear_sum_assignment(torch.cdist(a[ia].double(), b[ib].double()).numpy())
    return ia[torch.as_tensor(rows)], ib[torch.as_tensor(cols)]


def motion_clusters(start: Tensor, end: Tensor, clusters: int, rounds: int = 20) -> Tensor:
    """Pairs [M, 3] of both states in ``clusters`` groups that move: 0 (still) .. clusters, [M] int64. For parts before
    any are known.

    k-means on (where a pair begins, where it ends), begun at farthest points; deterministic.
    """
    moved = (end - start).square().sum(1)
    index = (moved > STILL * moved.max()).nonzero().squeeze(1)
    labels = torch.zeros(len(start), dtype=torch.int64)
    if clusters < 1 or len(index) < clusters:
        return labels
    points = torch.cat([start, end], 1)[index].double()
    centres = points[farthest_points(points[:, :3], clusters)]
    for _ in range(rounds):
        nearest = torch.cdist(points, centres).argmin(1)
        centres = torch.stack(
            [points[nearest == k].mean(0) if bool((nearest == k).any()) else centres[k] for k in range(clusters)]
        )
    labels[index] = nearest + 1
    return labels
