"""How well all photographs agree along rays: where most of them show the ray's colour, a surface is.

Plane sweeping (Collins 1996, https://doi.org/10.1109/CVPR.1996.517097) with every view instead of a few neighbours, and
bounded votes (as in Vogiatzis et al. 2007, https://doi.org/10.1109/TPAMI.2007.70712): a view from which the surface is
hidden agrees nowhere on the ray, so it tips no balance.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from p2gs.native import native, num_threads


class Pictures(NamedTuple):
    """Photographs to look at together, float32.  pixels [V, H, W, 4]: of each view the first sizes [V, 2] (width,
    height); lines [V, 3, 4]: world to pixel times depth (K [R | t])."""

    pixels: Tensor
    sizes: Tensor
    lines: Tensor


@torch.no_grad()
def agreement(
    pictures: Pictures, origins: Tensor, ways: Tensor, colours: Tensor, depths: Tensor, tolerance: float
) -> Tensor:
    """How well the views agree with each ray's colour at the points origin + depth * way, [N, D].

    origins, ways [N, 3]; colours [N, 4] of the rays; depths [D]; all float32. tolerance: sum over the channels of the
    difference in colour at which a view does not agree at all; 0 to 1 in the mean of the views, those that do not
    contain the point counting as 0. Raises ValueError on shapes that do not belong together.
    """
    V = len(pictures.pixels)
    shapes = [tuple(t.shape) for t in (pictures.pixels, pictures.sizes, pictures.lines, origins, ways, colours)]
    if shapes[0][3:] != (4,) or shapes[1:3] != [(V, 2), (V, 3, 4)]:
        raise ValueError(f"agreement wants pixels [V, H, W, 4], sizes [V, 2], lines [V, 3, 4], got {shapes[:3]}")
    if shapes[3:] != [(len(ways), 3), (len(ways), 3), (len(ways), 4)]:
        raise ValueError(f"agreement wants origins and ways [N, 3], colours [N, 4], got {shapes[3:]}")
    given = [t.contiguous() for t in (*pictures, origins, ways, colours, depths)]
    if native is None or any(t.dtype != torch.float32 or t.is_cuda for t in given):
        return agreement_reference(pictures, origins, ways, colours, depths, tolerance)
    out = torch.empty(len(ways), len(depths))
    shape = [*pictures.pixels.shape[:3], len(depths)]
    native.sweep([t.data_ptr() for t in given], shape, len(ways), tolerance, out.data_ptr(), num_threads())
    return out


def agreement_reference(
    pictures: Pictures, origins: Tensor, ways: Tensor, colours: Tensor, depths: Tensor, tolerance: float
) -> Tensor:
    """``agreement`` in torch, view by view, in the dtype and on the device of the pictures."""
    points = origins[:, None] + depths[None, :, None] * ways[:, None]  # [N, D, 3]
    total = points.new_zeros(points.shape[:2])
    for pixels, (W, H), line in zip(*pictures, strict=True):
        seen = points @ line[:, :3].T + line[:, 3]
        x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
        inside = (seen[..., 2] > 0) & (x >= 0) & (x < W) & (y >= 0) & (y < H)
        at = torch.stack([2 * x / W - 1, 2 * y / H - 1], -1).where(inside[..., None], 0)
        own = pixels[: int(H), : int(W)].permute(2, 0, 1)[None]
        there = torch.nn.functional.grid_sample(own, at[None], padding_mode="border", align_corners=False)[0]
        off = (there - colours.T[:, :, None]).abs().sum(0) / tolerance
        total += (1 - off).clamp(min=0) * inside
    return total / len(pictures.pixels)
