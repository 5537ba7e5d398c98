"""What a moving point meets when it lands in a state: constant-time look-ups of surface, free and hidden space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from p2gs.motion.discovery.rigid import Motions
from p2gs.native import native, num_threads
from p2gs.visibility.depth_stack import DepthStack
from p2gs.visibility.surfels import Surfels


def normal_code(n: Tensor) -> Tensor:
    """Facing [..., 3] -> one of 27 sign patterns (a component counts when above 0.38); 13 is the impossible zero
    pattern."""
    s = (n > 0.38).to(torch.int32) - (n < -0.38).to(torch.int32) + 1
    return (s[..., 0] * 3 + s[..., 1]) * 3 + s[..., 2]


def code_directions() -> Tensor:
    """[27, 3] unit vectors of the patterns (zero for pattern 13)."""
    g = torch.stack(torch.meshgrid(*[torch.arange(-1.0, 2.0)] * 3, indexing="ij"), -1).reshape(27, 3)
    return g / g.norm(dim=1, keepdim=True).clamp_min(1e-9)


def surfel_rows(surfels: Surfels, static: Tensor) -> Tensor:
    """[N, 12] as the kernels read surfels: point, normal, colour, static [N] as 0 or 1, two zeros."""
    return torch.cat(
        [surfels.points, surfels.normals, surfels.colours, static[:, None], torch.zeros(len(surfels), 2)], 1
    ).float()


@dataclass
class Scale:
    """Lengths that every threshold is made of. tau: depth tolerance; tp: tolerance across a surface; spacing; diag: box
    diagonal."""

    tau: float
    tp: float
    spacing: float
    diag: float

    @property
    def apart(self) -> float:
        """How far apart two motions must carry a body for its surfaces, many points together, to tell them apart."""
        return self.tp / 3


class Landing:
    """Cost in 0..1 of a surfel arriving somewhere in one state.

    Arriving on a like surface costs nothing, inside space the state's cameras never saw 0.35, deep in space they saw to
    be empty 1, on a surface that never moved 0.2 more.  A plate of known thickness may show its other side: arriving
    that far behind a surface that faces the other way costs 0.1, half of what colours that disagree cost, as the sides'
    colours tell nothing.
    """

    HIDDEN = 0.35
    ON_STATIC = 0.20
    TWO_SIDED = 0.10

    def __init__(
        self,
        surfels: Surfels,
        static: Tensor,
        stack: DepthStack,
        lo: Tensor,
        hi: Tensor,
        scale: Scale,
        cells: float = 3e5,
    ):
        self.surfels, self.static, self.scale = surfels, static, scale
        self.h = float(((hi - lo).prod() / cells) ** (1 / 3))
        self.lo = lo
        self.size = ((hi - lo) / self.h).ceil().long() + 1
        centre = self._centres(self.size, self.h)
        free, on, _ = stack.counts(centre, scale.tau, stack.spread(32))
        mask = ((free >= 2) & (free > 1.5 * on)).reshape(tuple(self.size)).numpy()
        self.depth_free = torch.from_numpy(ndimage.distance_transform_edt(mask).astype(np.float32) * self.h).reshape(-1)
        self.hc = 2 * self.h
        self.coarse = ((hi - lo) / self.hc).ceil().long() + 1
        self.nearest = self._nearest()
        self.rows = surfel_rows(surfels, static)

    def _centres(self, size: Tensor, h: float) -> Tensor:
        axes = [torch.arange(int(s)) * h + float(o) + h / 2 for s, o in zip(size, self.lo, strict=False)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def _nearest(self) -> Tensor:
        """[27 * voxels] int32: nearest surfel that faces like the pattern (pattern 13: nearest of all)."""
        s = self.surfels
        cell = self._index(s.points, self.coarse, self.hc)
        off = ((s.points - self.lo) / self.hc % 1 - 0.5).norm(dim=1)
        order = off.argsort(descending=True)  # the surfel nearest to the voxel's centre is written last
        shape = tuple(int(v) for v in self.coarse)
        table = torch.zeros(27, int(self.coarse.prod()), dtype=torch.int32)
        directions = code_directions()
        for code in range(27):
            fits = order if code == 13 else order[(s.normals[order] @ directions[code]) > 0.5]
            if len(fits) == 0:
                fits = order
            first = np.full(len(table[0]), -1, np.int64)
            first[cell[fits].numpy()] = fits.numpy()
            grid = first.reshape(shape)
            idx = ndimage.distance_transform_edt(grid < 0, return_distances=False, return_indices=True)
            table[code] = torch.from_numpy(grid[tuple(idx)].reshape(-1).astype(np.int32))
        return table.reshape(-1)

    def _index(self, x: Tensor, size: Tensor, h: float) -> Tensor:
        i = ((x - self.lo) / h).long()
        i = torch.minimum(i.clamp_min(0), (size - 1).expand_as(i))
        return (i[..., 0] * size[1] + i[..., 1]) * size[2] + i[..., 2]

    def match(self, x: Tensor, n: Tensor) -> Tensor:
        """Index of the surfel that a point [..., 3] facing n [..., 3] meets."""
        voxels = int(self.coarse.prod())
        return self.nearest[normal_code(n).long() * voxels + self._index(x, self.coarse, self.hc)].long()

    def free(self, x: Tensor) -> Tensor:
        """How deep in seen-free space: 0 at its border to 1 within a voxel or two."""
        depth = self.depth_free[self._index(x, self.size, self.h)]
        return ((depth - 0.5 * self.h) / (2 * self.h)).clamp(0, 1)

    def cost(
        self, x: Tensor, n: Tensor, c: Tensor | None = None, claimed: Tensor | None = None, thick: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Cost [...] and matched surfel [...]. claimed [M] in 0..1: surfels that another part explains already cost
        like static ones.
        thick [...]: of the plate that arrives; where above 0 its other side may be what is met."""
        cost, j = self.matching(x, n, c, claimed)
        free = self.free(x)
        if thick is not None:
            other, behind = self.matching(x - thick[..., None] * n, -n, None, claimed)
            other = torch.where(thick > 0, torch.maximum(free, self.TWO_SIDED + other), torch.inf)
            j = torch.where(other < cost, behind, j)
            cost = torch.minimum(cost, other)
        return torch.minimum(cost, self.HIDDEN + (1 - self.HIDDEN) * free).clamp_max(1), j

    def matching(self, x: Tensor, n: Tensor, c: Tensor | None, claimed: Tensor | None) -> tuple[Tensor, Tensor]:
        """Cost [...] of taking the surfel met for one's own place, and that surfel [...]; c: None where colours are
        another side's."""
        s, k = self.surfels, self.scale
        j = self.match(x, n)
        d = x - s.points[j]
        m = s.normals[j]
        dp = (d * m).sum(-1)
        dt = (d.pow(2).sum(-1) - dp * dp).clamp_min(0).sqrt()
        cost = (((dp.abs() - 0.3 * k.tp) / (0.7 * k.tp)).clamp_min(0)) ** 2
        cost = cost + ((dt - self.hc - k.spacing).clamp_min(0) / k.spacing) ** 2
        cost = cost + 0.3 * (0.9 - (n * m).sum(-1)).clamp_min(0)
        if c is not None:
            cost = cost + 0.2 * (((s.colours[j] - c).abs().mean(-1) - 0.1) / 0.5).clamp(0, 1)
        taken = self.static[j].float() if claimed is None else torch.maximum(self.static[j].float(), claimed[j])
        return cost + self.ON_STATIC * taken, j

    def arrive(
        self, motions: Motions, source: "Landing", index: Tensor, back: bool = False, claimed: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Cost [B, P] and matched surfel [B, P] of the surfels ``index`` [P] of the other state, ``source``, carried
        here by motions or, ``back``, by their inverses.  One pass of a kernel where there is one, else ``cost``, which
        it equals up to rounding."""
        if not self.fused:
            s = source.surfels
            x, n = motions.apply(s.points[index], back), motions.rotate(s.normals[index], back)
            return self.cost(x, n, s.colours[index], claimed, motions.thick[:, None].expand(x.shape[:-1]))
        index = index.contiguous()
        cost = torch.empty(len(motions), len(index))
        met = torch.empty(len(motions), len(index), dtype=torch.long)
        claimed = None if claimed is None else claimed.float().contiguous()
        if cost.numel():
            moving, thick = motions.packed(), motions.thick.float().contiguous()
            native.landing_cost(
                *self.tables(),
                0 if claimed is None else claimed.data_ptr(),
                [m.data_ptr() for m in moving],
                thick.data_ptr(),
                len(motions),
                back,
                source.rows.data_ptr(),
                len(source.rows),
                index.data_ptr(),
                len(index),
                cost.data_ptr(),
                met.data_ptr(),
                num_threads(),
            )
        return cost, met

    @property
    def fused(self) -> bool:
        """Do the kernels know this state's surfels?"""
        return native is not None and len(self.surfels) > 0 and self.surfels.points.device.type == "cpu"

    def tables(self) -> tuple[list[int], list[float], list[int]]:
        """This state as the kernels take it: addresses, lengths and costs, grid sizes."""
        k = self.scale
        return (
            [self.nearest.data_ptr(), self.depth_free.data_ptr(), self.rows.data_ptr()],
            [*self.lo.tolist(), self.h, self.hc, k.tp, k.spacing, self.HIDDEN, self.ON_STATIC, self.TWO_SIDED],
            [*self.size.tolist(), *self.coarse.tolist()],
        )
