"""Depth views averaged into a truncated signed distance field: a native kernel, and the same in torch."""

from __future__ import annotations

from typing import Sequence

import torch
from torch import Tensor

from p2gs.native import native, num_threads
from p2gs.surface.depth_view import DepthView, pixels

CHUNK = 1 << 16  # voxels
# of a view that sees through a voxel, against 1 of a view that sees surface in it head-on and for sure
FREE_WEIGHT = 0.3


def integrate(
    points: Tensor, views: Sequence[DepthView], matrices: Sequence[Tensor], part: int, trunc: float, behind: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Signed distance in units of trunc [n], weight of surface sightings [n], colour [n, 3] and weight of all that the
    distance is the mean of [n], at points [n, 3] float32.

    views: with normals, float32 maps, int16 labels and uint8 colours, all on the CPU.  matrices: ``pixel_matrix`` of
    each.  part: in ``views``.
    trunc: distance in front of the surface at which space counts as free.  behind: how far behind the surface it still
    counts. The same bits for any number of threads.  Raises ValueError for a view without normals or with maps of other
    shapes than its camera's.
    """
    for view in views:
        shape = (view.camera.height, view.camera.width)
        maps = (view.depth, view.labels, view.normal_dot, view.cosine, view.colour)
        if any(m is None or m.shape[:2] != shape for m in maps) or view.colour.dtype != torch.uint8:
            raise ValueError(
                f"a view of {shape[1]} x {shape[0]} pixels wants depth, labels, normal_dot, cosine and uint8 colour "
                "of that size"
            )
    if native is None:
        return integrate_reference(points, views, matrices, part, trunc, behind)
    kept, rows = [], []  # copies, where a view's maps are not contiguous, must outlive the call
    for view in views:
        depth, dot, cosine = (m.float().contiguous() for m in (view.depth, view.normal_dot, view.cosine))
        kept.append((depth, view.labels.short().contiguous(), dot, cosine, view.colour.contiguous()))
        rows.append([m.data_ptr() for m in kept[-1]] + [view.camera.width, view.camera.height])
    points, n = points.float().contiguous(), len(points)
    out = [torch.empty(n), torch.empty(n), torch.empty(n, 3), torch.empty(n)]
    table = torch.tensor(rows, dtype=torch.int64).reshape(-1, 7)
    lines = torch.stack(list(matrices)).float().contiguous() if len(rows) else torch.zeros(0, 3, 4)
    limits, addresses = [trunc, behind, FREE_WEIGHT], [t.data_ptr() for t in out]
    native.fuse_views(
        table.data_ptr(), lines.data_ptr(), len(rows), part, limits, points.data_ptr(), n, addresses, num_threads()
    )
    return tuple(out)


def integrate_reference(
    points: Tensor, views: Sequence[DepthView], matrices: Sequence[Tensor], part: int, trunc: float, behind: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``integrate``, its shapes too, in torch, in the dtype of ``points``."""
    maps = [_pixel_table(v, part).to(points) for v in views]
    matrices = [M.to(points) for M in matrices]
    chunks = points.split(CHUNK)  # small enough to stay in cache through all views
    return tuple(
        torch.cat(x) for x in zip(*(_chunk(x, views, maps, matrices, trunc, behind) for x in chunks), strict=True)
    )


def _pixel_table(view: DepthView, part: int) -> Tensor:
    """[H W + 1, 6] float32 a pixel: depth (1e9 where nothing is), |n . ray|, cosine on this part (else 0), RGB. The
    last row: outside."""
    depth = torch.where(view.labels < 0, torch.full_like(view.depth, 1e9), view.depth)
    cosine = torch.where(view.labels == part, view.cosine, torch.zeros_like(view.cosine))
    table = torch.cat(
        [depth[..., None], view.normal_dot.clamp_min(0.05)[..., None], cosine[..., None], view.colour / 255], -1
    ).reshape(-1, 6)
    return torch.cat([table, torch.tensor([[-1e9, 1.0, 0, 0, 0, 0]])])


def _chunk(x: Tensor, views, maps, matrices, trunc: float, behind: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    total, weight = x.new_zeros(len(x)), x.new_full((len(x),), 1e-9)
    tint = x.new_full((len(x), 4), 1e-9)
    columns = x.T.contiguous()
    for view, table, M in zip(views, maps, matrices, strict=True):
        z, pixel = pixels(columns, M, view.camera)
        row = table.index_select(0, pixel)
        gap = row[:, 0] - z
        d = gap * row[:, 1]
        free = (gap > trunc) & (d > 0.5 * trunc)
        near = (~free & (d > -behind)) * row[:, 2]
        w = torch.where(free, FREE_WEIGHT, near)
        weight += w
        total += w * (d / trunc).clamp_(-1, 1).masked_fill_(free, 1.0)
        # colour from sightings right at the voxel: those of a thin wall's other side are only a few voxels away
        near *= (d < trunc) * torch.exp(-((4 * d / trunc) ** 2)).clamp_min_(1e-4)
        tint[:, 0] += near
        tint[:, 1:] += near[:, None] * row[:, 3:]
    seen = tint[:, 0]
    return total / weight, torch.where(seen > 1e-7, seen, torch.zeros_like(seen)), tint[:, 1:] / seen[:, None], weight
