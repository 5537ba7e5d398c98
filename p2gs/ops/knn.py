"""Nearest neighbours: a native tree on the CPU, all distances in blocks elsewhere."""

from __future__ import annotations

from typing import Optional

import torch
from torch import Tensor

from p2gs.native import native, num_threads


@torch.no_grad()
def knn(points: Tensor, queries: Optional[Tensor], k: int, exclude_self: bool = False) -> tuple[Tensor, Tensor]:
    """The k nearest of ``points`` to each of ``queries`` (None: the points themselves), nearest first, ties by index.

    points [N, 3], queries [M, 3], finite.  exclude_self: query i is point i and shall not find itself; a twin at the
    same place does count.  Returns (distances [M, k] in the points' dtype, indices [M, k] int64), both without
    gradient. The same bits for any number of threads. Raises ValueError when there are fewer than k points to find,
    when exclude_self is asked of foreign queries, or on NaN.
    """
    for name, x in (("points", points), ("queries", queries)):
        if x is None:
            continue
        if x.ndim != 2 or x.shape[1] != 3:
            raise ValueError(f"knn wants {name} [N, 3], got {tuple(x.shape)}")
        if x.numel() and not x.abs().max() < 1e18:
            raise ValueError(f"knn wants finite {name}")
    if exclude_self and queries is not None and queries is not points:
        raise ValueError("exclude_self is for the points' own neighbours: give queries as None")
    if k < 1 or k + bool(exclude_self) > points.shape[0]:
        raise ValueError(
            f"{k} neighbours asked of {points.shape[0]} points" + (", each without itself" if exclude_self else "")
        )
    queries = None if queries is points else queries
    if native is None or points.dtype != torch.float32 or points.device.type != "cpu":
        return knn_reference(points, queries, k, exclude_self)
    points = points.contiguous()
    queries = None if queries is None else queries.to(points).contiguous()
    count = points.shape[0]
    asked = count if queries is None else queries.shape[0]
    distance = points.new_empty(asked, k)
    index = torch.empty(asked, k, dtype=torch.int64)
    address = 0 if queries is None else queries.data_ptr()
    if asked:
        native.knn(
            points.data_ptr(),
            count,
            address,
            asked,
            k,
            exclude_self,
            distance.data_ptr(),
            index.data_ptr(),
            num_threads(),
        )
    return distance, index


@torch.no_grad()
def knn_reference(
    points: Tensor, queries: Optional[Tensor], k: int, exclude_self: bool = False, block: int = 4_000_000
) -> tuple[Tensor, Tensor]:
    """``knn``, its shapes too, by all distances, ``block`` of them at a time: any dtype and device."""
    queries = points if queries is None else queries.to(points)
    rows = max(1, block // points.shape[0])
    found = []
    for start in range(0, queries.shape[0], rows):
        part = queries[start : start + rows]
        distance = torch.linalg.vector_norm(part[:, None] - points[None], dim=-1)
        if exclude_self:
            here = torch.arange(part.shape[0], device=points.device)
            distance[here, start + here] = torch.inf
        found.append(distance.topk(k, largest=False, sorted=True))
    if not found:
        return points.new_empty(0, k), torch.empty(0, k, dtype=torch.int64, device=points.device)
    return torch.cat([d for d, _ in found]), torch.cat([i for _, i in found])


def search_tree(points):
    """scipy's k-d tree of points [N, D], an array: for other questions than ``knn``'s."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    return cKDTree(points)
