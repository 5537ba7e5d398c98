"""Walls that are known from outside, as a grid that rays meet, and the backdrop that photographs paint on their inner
sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from p2gs.ops import so3
from p2gs.ops.knn import knn
from p2gs.ops.sh import rgb_to_dc
from p2gs.types import GaussianTensors

REACH = 0.3  # how far the colours of a wall are carried to where no ray fell on it, internal units
DEEPEST = 2.0  # how far behind a surface a wall is looked for, internal units


def over_surface(g: GaussianTensors, count: int = 24, seed: int = 0) -> Tensor:
    """``count`` points of each Gaussian's body, within 1.7 standard deviations, [N * count, 3]."""
    z = (
        torch.randn(len(g), count, 3, generator=torch.Generator().manual_seed(seed)).clamp(-1.7, 1.7)
        * g.log_scales.exp()[:, None]
    )
    R = so3.quat_to_matrix(so3.quat_normalize(g.quats))
    return (g.means[:, None] + (R[:, None] * z[:, :, None]).sum(-1)).reshape(-1, 3)


class Walls:
    """Where the base is known to be solid, as a grid, closed by the sides of the box around everything.

    points [N, 3] on known surfaces; lo, hi [3]: the box.  cell: size of a voxel.
    """

    def __init__(self, points: Tensor, lo: Tensor, hi: Tensor, cell: float):
        self.lo, self.cell = lo.double() - 2 * cell, cell
        self.size = ((hi.double() + 2 * cell - self.lo) / cell).ceil().long() + 1
        grid = torch.zeros(tuple(self.size.tolist()), dtype=torch.bool)
        at, inside = self._voxels(points)
        grid[tuple(at[inside].T)] = True
        # the gaps between the Gaussians of a wall
        self.grid = torch.from_numpy(ndimage.binary_closing(grid.numpy())) | grid
        for axis in range(3):
            for side in (slice(0, 3), slice(-3, None)):
                self.grid[(slice(None),) * axis + (side,)] = True

    def _voxels(self, points: Tensor) -> tuple[Tensor, Tensor]:
        at = ((points.double() - self.lo) / self.cell).floor().long()
        return at, ((at >= 0) & (at < self.size)).all(-1)

    def meet(self, origins: Tensor, ways: Tensor, chunk: int = 4096) -> Tensor:
        """Distance [R] at which rays from origins [R, 3] along unit ways [R, 3] meet a wall, from two voxels on; inf
        where they do not."""
        steps = torch.arange(2 * self.cell, DEEPEST, self.cell / 2, dtype=torch.float64)
        out = []
        for o, w in zip(origins.double().split(chunk), ways.double().split(chunk), strict=True):
            at, inside = self._voxels(o[:, None] + w[:, None] * steps[:, None])
            hit = inside & self.grid[tuple(torch.where(inside[..., None], at, 0).unbind(-1))]
            out.append(torch.where(hit.any(1), steps[hit.to(torch.uint8).argmax(1)], torch.inf))
        return torch.cat(out) if out else torch.zeros(0, dtype=torch.float64)


@dataclass
class Backdrop:
    """What rays through patches meet behind them. points [P, 3]; of each ray its point [R], colour [R, 3] and patch
    [R]; boards: how many were found between the patches and the walls."""

    points: Tensor
    where: Tensor
    colours: Tensor
    patch: Tensor
    cell: float
    boards: int = 0

    def paint(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Mean colour [P, 3] of the rays through the patches ``chosen`` [K] bool, and which points one fell on [P]."""
        rays = chosen[self.patch]
        count = torch.zeros(len(self.points)).index_add_(0, self.where[rays], torch.ones(int(rays.sum())))
        colour = torch.zeros(len(self.points), 3).index_add_(0, self.where[rays], self.colours[rays])
        return colour / count.clamp_min(1)[:, None], count > 0

    def gaussians(self, chosen: Tensor, bases: int) -> tuple[GaussianTensors, Tensor]:
        """The backdrop as rays through the patches ``chosen`` [K] bool paint it, gaps in the colours beside them;
        ``bases`` of the SH. And which of its Gaussians a ray fell on or beside."""
        colour, painted = self.paint(chosen)
        keep, near = painted.clone(), painted.clone()
        if painted.any() and not painted.all():
            distance, index = knn(self.points[painted], self.points[~painted], min(4, int(painted.sum())), False)
            colour[~painted] = colour[painted][index].mean(1)
            keep[~painted], near[~painted] = distance[:, 0] < REACH, distance[:, 0] < 3 * self.cell
        n = int(keep.sum())
        sh = torch.zeros(n, bases, 3)
        sh[:, 0] = rgb_to_dc(colour[keep])
        size = torch.full((n, 3), float(np.log(0.8 * self.cell)))
        quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
        return GaussianTensors(self.points[keep], quats, size, torch.full((n,), 3.0), sh), near[keep]
