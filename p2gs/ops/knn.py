"""Nearest neighbours: a kd-tree on the CPU, blocks of distances on a GPU."""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor

from p2gs.native import num_threads


@torch.no_grad()
def knn(points: Tensor, queries: Optional[Tensor], k: int, exclude_self: bool = False) -> tuple[Tensor, Tensor]:
    """The k nearest of ``points`` to each of ``queries`` (None: the points themselves), nearest first.

    points [N, 3], queries [M, 3], finite.  exclude_self: query i is point i and shall not find itself; a twin at the same place
    does count.  Returns (distances [M, k] in the points' dtype, indices [M, k] int64), both without gradient. The same input gives
    the same answer, for any number of threads.
    Raises ValueError when there are fewer than k points to find, when exclude_self is asked of foreign queries, or on NaN.
    """
    if exclude_self and queries is not None and queries.shape[0] != points.shape[0]:
        raise ValueError(f"exclude_self wants one query a point, got {queries.shape[0]} queries for {points.shape[0]} points")
    queries = points if queries is None else queries
    wanted = k + bool(exclude_self)
    if k < 1 or wanted > points.shape[0]:
        raise ValueError(f"{k} neighbours asked of {points.shape[0]} points" + (" with the point itself left out" if exclude_self else ""))
    search = _tree if points.device.type == "cpu" else knn_reference
    distance, index = search(points, queries, wanted)
    if not exclude_self:
        return distance, index
    # Leave out the point itself; where more than k twins hide it, leave out the last found instead.
    own = index == torch.arange(index.shape[0], device=index.device)[:, None]
    own[:, -1] |= ~own.any(dim=1)
    shape = (index.shape[0], k)
    return distance[~own].view(shape), index[~own].view(shape)


def _tree(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    from scipy.spatial import cKDTree

    # Sliding midpoint instead of medians: half the time to build, and as fast to ask for points on surfaces.
    tree = cKDTree(points.detach().double().numpy(), balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(queries.detach().double().numpy(), k=range(1, k + 1), workers=num_threads())
    return torch.from_numpy(distance).to(points.dtype), torch.from_numpy(index).long()


def knn_reference(points: Tensor, queries: Tensor, k: int, block: int = 4096) -> tuple[Tensor, Tensor]:
    """All distances, ``block`` queries at a time, in any dtype and on any device: for GPUs, and to hold the tree against."""
    found = []
    for part in queries.split(block):
        distance = torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist")
        found.append(distance.topk(k, largest=False, sorted=True))
    return torch.cat([d for d, _ in found]), torch.cat([i for _, i in found])
