"""Boards inside: flat surfaces across the coordinate axes that photographs through an opening agree on.

Shelves, partitions, the bottoms of drawers. Where rays of many photographs meet what is there, the colours that fall on
one place agree; before and behind it they do not. Dim and noisy insides tell so little of any one place that training
does not find it, but a whole plane is unmistakable (plane sweeping, https://doi.org/10.1109/CVPR.1996.517097). Not in
the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

CELL = 0.03  # places on a board within which colours are compared, internal units
STEP = 0.02  # between the planes that are tried
FINE = 0.005  # and around the best
ENOUGH = 20_000  # rays that choose
FEW = 5000  # rays, of which no plane can be told
LEAST = 0.01  # share of the rays that a board must stop, and of their disagreement that it must do away with
MOST = 6  # boards


@dataclass
class Rays:
    """Rays of photographs into an opening.  start [R, 3], unit way [R, 3], far [R]: the distance at which they end, all
    float64; colour [R, 3]; patch [R]: the one they pass."""

    start: Tensor
    way: Tensor
    far: Tensor
    colour: Tensor
    patch: Tensor

    def __getitem__(self, rows: Tensor) -> "Rays":
        return Rays(self.start[rows], self.way[rows], self.far[rows], self.colour[rows], self.patch[rows])


@dataclass
class Board:
    """A part of a plane across a coordinate axis.  axis: 0, 1 or 2; offset: along it; lo [2]: where its ``mask`` [A, B]
    bool, of cells, begins along the next two."""

    axis: int
    offset: float
    lo: Tensor
    mask: Tensor

    def distance(self, rays: Rays, near: float) -> Tensor:
        """Distance [R] at which rays meet the plane, from ``near`` on and before they end; inf where they do not."""
        t = (self.offset - rays.start[:, self.axis]) / rays.way[:, self.axis]
        return torch.where((t > near) & (t < rays.far), t, torch.inf)  # nan and inf of parallel ones compare false

    def cells(self, rays: Rays, t: Tensor) -> Tensor:
        """Cell [R] of the plane at distances t [R], numbered over the mask; those beyond its rim count as on it."""
        at = ((rays.start + t[:, None] * rays.way)[:, _others(self.axis)] - self.lo) / CELL
        a, b = (x.floor().long().clamp(0, n - 1) for x, n in zip(at.unbind(1), self.mask.shape, strict=True))
        return a * self.mask.shape[1] + b

    def meet(self, rays: Rays, near: float) -> Tensor:
        """Distance [R] at which rays meet it, from ``near`` on and before they end; inf where they do not."""
        t = self.distance(rays, near)
        rows = t.isfinite().nonzero().squeeze(1)
        past = rows[~self.mask.reshape(-1)[self.cells(rays[rows], t[rows])]]
        return t.index_fill(0, past, torch.inf)


def disagreement(cells: Tensor, colours: Tensor) -> Tensor:
    """Variance of the colours [R, 3] that fall on one cell [R] int64, [R] float64; nan where it is the only one
    there."""
    where = torch.unique(cells, return_inverse=True)[1]
    n = torch.bincount(where).double()
    colours = colours.double()
    mean, square = (
        torch.zeros(len(n), 3, dtype=torch.float64).index_add_(0, where, c) / n[:, None] for c in (colours, colours**2)
    )
    return ((square - mean**2).sum(1) * n / (n - 1))[where]


def _others(axis: int) -> list[int]:
    return [(axis + 1) % 3, (axis + 2) % 3]


def find_boards(rays: Rays, lo: Tensor, hi: Tensor, near: float, stay: bool) -> list[Board]:
    """Boards on which the colours of rays [R] (float64) agree better than where they end; best first, and each one ends
    those that meet it before the next is looked for.

    lo, hi [3]: the box in which they are looked for.  near: how far behind the rays' start the first may be.  stay:
    where the rays of a patch agree better at their start than at their end, only what is better than that counts.
    """
    if len(rays.far) < FEW:
        return []
    rays = rays[torch.linspace(0, len(rays.far) - 1, min(len(rays.far), ENOUGH)).long()]
    size = ((hi - lo) / CELL).ceil().long().clamp_min(1).tolist()
    others = [_others(i) for i in range(3)]
    planes = [
        Board(i, 0.0, lo[others[i]], torch.ones([size[j] for j in others[i]], dtype=torch.bool)) for i in range(3)
    ]

    def at(points: Tensor) -> Tensor:
        a, b, c = ((points - lo) / CELL).floor().long().unbind(1)
        return disagreement((a * 4096 + b) * 4096 + c, rays.colour)

    now = at(rays.start + rays.far[:, None] * rays.way)
    if stay:
        before, patches = at(rays.start), int(rays.patch.max()) + 1
        sums = torch.zeros(2, patches, dtype=torch.float64)
        for total, x in zip(sums, (before, now), strict=True):
            total.index_add_(0, rays.patch, x.nan_to_num(0.0))
        now = torch.where((sums[0] < sums[1])[rays.patch], before, now)
    boards: list[Board] = []
    while len(boards) < MOST:
        tried = (
            replace(planes[i], offset=float(c))
            for i in range(3)
            for c in torch.arange(float(lo[i]), float(hi[i]), STEP)
        )
        best = max(tried, key=partial(_gain, rays=rays, now=now, near=near))
        finer = (replace(best, offset=best.offset + k * FINE) for k in range(-3, 4))
        best = max(finer, key=partial(_gain, rays=rays, now=now, near=near))
        rows, cells, less = _saved(best, rays, now, near)
        sums = torch.zeros(best.mask.numel(), dtype=torch.float64).index_add_(0, cells, less).reshape(best.mask.shape)
        best = replace(best, mask=torch.nn.functional.avg_pool2d(sums[None, None], 3, 1, 1)[0, 0] > 0)
        kept = best.mask.reshape(-1)[cells]
        if float(less[kept].sum()) <= LEAST * float(now.nansum()) or int(kept.sum()) <= LEAST * len(now):
            break
        boards.append(best)
        rays = replace(rays, far=torch.minimum(rays.far, best.meet(rays, near)))
        now = now.index_add(0, rows[kept], -less[kept])
    return boards


def _saved(plane: Board, rays: Rays, now: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """The rays that a plane ends, their cells on it, and by how much they disagree less there than ``now`` [R]."""
    t = plane.distance(rays, near)
    rows = t.isfinite().nonzero().squeeze(1)
    cells = plane.cells(rays[rows], t[rows])
    return rows, cells, (now[rows] - disagreement(cells, rays.colour[rows])).nan_to_num(0.0)


def _gain(plane: Board, rays: Rays, now: Tensor, near: float) -> float:
    return float(_saved(plane, rays, now, near)[2].sum())
