"""Where repel points are put: on the static base, near the parts that move (paper appendix, "Repel Point
Initialization")."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.repel import repel_force

__all__ = ["place_repel_points", "repel_force"]

ThresholdMode = Literal["relative", "absolute", "spacing"]


def place_repel_points(
    static_points: Tensor,
    movable_points: Tensor,
    count: int = 2000,
    threshold: float = 0.05,
    mode: ThresholdMode = "relative",
    noise: float = 0.0,
    generator: torch.Generator | None = None,
    extent: float | None = None,
) -> Tensor:
    """Static points nearer to a movable point than the threshold, ``count`` of them drawn uniformly without repetition:
    [R, 3].

    static_points [S, 3], movable_points [M, 3]: Gaussian centres in one common pose. R = min(count, how many are near);
    none near (or no movable point) gives [0, 3].
    threshold: a fraction of ``extent`` ("relative"; by default the diagonal of all points' box), a length ("absolute";
    the paper says 1.5, which takes in every point of an object of the benchmarks' size), or a multiple of the static
    points' median nearest-neighbour distance ("spacing").
    noise: length of an offset in a random direction (the paper's sigma_r, "3D offsets with magnitude sigma_r", times
    the extent). No gradient. Raises ValueError for another mode.
    """
    static, movable = static_points.detach(), movable_points.detach()
    if len(static) == 0 or len(movable) == 0 or count <= 0:
        return static.new_zeros((0, 3))
    if extent is None:
        both = torch.cat([static, movable])
        extent = (both.amax(0) - both.amin(0)).norm().item()
    reach = {
        "relative": lambda: threshold * extent,
        "absolute": lambda: threshold,
        "spacing": lambda: threshold * _spacing(static),
    }
    if mode not in reach:
        raise ValueError(f"threshold mode '{mode}' is not one of {', '.join(reach)}")
    distance, _ = search_tree(movable.cpu().numpy()).query(static.cpu().numpy())
    near = torch.from_numpy(distance < reach[mode]()).nonzero()[:, 0]
    chosen = near[torch.randperm(len(near), generator=generator)[:count]]
    points = static[chosen.to(static.device)]
    if noise > 0:
        way = torch.randn(points.shape, generator=generator).to(points)
        points = points + noise * torch.nn.functional.normalize(way, dim=1)
    return points


def _spacing(points: Tensor) -> float:
    x = points.cpu().numpy()
    if len(x) < 2:
        return 0.0
    return float(torch.from_numpy(search_tree(x).query(x, k=2)[0][:, 1]).median())
