"""Gaussians in patches: what is near, faces alike and has a like colour."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.gaussians.pose import shortest_axes
from p2gs.motion.matching import farthest_points
from p2gs.ops.sh import dc_to_rgb
from p2gs.types import GaussianTensors


def patches(g: GaussianTensors, size: int, rounds: int = 10) -> Tensor:
    """Patch [N] of each Gaussian: near, alike in facing and colour, ``size`` in the mean (k-means from farthest
    points)."""
    normal = shortest_axes(g)
    facing = (normal[:, :, None] * normal[:, None]).flatten(1)
    x = torch.cat([g.means / 0.06, 0.7 * facing, 2 * dc_to_rgb(g.sh[:, 0]).clamp(0, 1)], 1).double()
    centre = x[farthest_points(g.means, max(1, len(g) // size))]
    for _ in range(rounds):
        patch = torch.cdist(x, centre).argmin(1)
        n = torch.zeros(len(centre), dtype=x.dtype).index_add_(0, patch, torch.ones_like(x[:, 0]))
        mean = torch.zeros_like(centre).index_add_(0, patch, x) / n.clamp_min(1)[:, None]
        centre = torch.where(n[:, None] > 0, mean, centre)
    return patch
