"""Where a state without depth starts: points on which its photographs agree.

From faint random points training closes dim openings with lids: what is in front becomes opaque first, and a lid
explains a dim inside nearly as well as the inside does. Begun on the inside it stays there, and its pictures are
sharper (docs/measured.md#where-single-states-start). Not in the paper.
"""

from __future__ import annotations

import math
from typing import Sequence

import torch
from torch import Tensor

from p2gs.data.box import mask_bounds
from p2gs.data.images import premultiply, resize_area
from p2gs.ops.rays import camera_rays
from p2gs.ops.sweep import Pictures, sweep
from p2gs.types import Camera, View

SIZE = 64  # pixels, long edge of the object in a picture: larger pixels average the noise of a dim inside away
EVERY = 2  # one ray for so many pixels, each way
TOLERANCE = 0.05  # sum over colour and alpha, 0 to 1 each: a few times the noise of such a pixel
BESIDE = 2  # steps of depth within which two views mean one place


def swept_points(views: Sequence[View], box: Tensor) -> tuple[Tensor, Tensor]:
    """Points [N, 3] with colours [N, 3] in 0..1 where rays of the photographs meet what all of them agree on.

    box [2, 3]: of the object, lowest and highest corner; rays are followed through it in steps of a pixel's size. A point is left out where rays of more
    views go on through it than end at it.
    """
    edges = [max(x1 - x0, y1 - y0) / max(v.alpha.shape) for v in views for x0, y0, x1, y1 in [mask_bounds(v.alpha)]]
    long_edge = SIZE / float(torch.tensor(edges).median())
    small = [_small(v, min(1.0, long_edge / max(v.alpha.shape))) for v in views]
    pictures, cameras = _stack(small), [c for _, c in small]
    corners = torch.cartesian_prod(*box.T)
    maps, points, colours = [], [], []
    for v, camera in enumerate(cameras):
        rows, cols = _looked_at(pictures.pixels[v])
        ways = camera_rays(camera)[rows, cols] @ camera.viewmat[:3, :3]
        depths = _depths(camera, corners)
        colour = pictures.pixels[v, rows, cols]
        index, _ = sweep(pictures, camera.position.expand(len(ways), 3), ways, colour, depths, TOLERANCE)
        points.append(camera.position + depths[index, None] * ways)
        colours.append(colour[:, :3] / colour[:, 3:])
        maps.append((_depth_map(camera, rows, cols, depths[index]), BESIDE * float(depths[1] - depths[0])))
    owner, found = torch.cat([torch.full((len(p),), v) for v, p in enumerate(points)]), torch.cat(points)
    kept = ((found >= box[0]) & (found <= box[1])).all(1) & _agreed(found, owner, cameras, maps)
    return found[kept], torch.cat(colours)[kept]


def _small(view: View, factor: float) -> tuple[Tensor, Camera]:
    """The photograph scaled down, premultiplied colour and alpha [H, W, 4] in 0..1, with its camera."""
    width, height = (max(EVERY, round(x * factor)) for x in (view.camera.width, view.camera.height))
    pixels = resize_area(premultiply(view.image.numpy(), view.alpha.numpy()), width, height)
    return torch.from_numpy(pixels) / 255, view.camera.scaled(width, height)


def _stack(small: Sequence[tuple[Tensor, Camera]]) -> Pictures:
    """Photographs with their cameras as one tensor, as large as the largest."""
    sizes = [(c.width, c.height) for _, c in small]
    pixels = torch.zeros(len(small), max(h for _, h in sizes), max(w for w, _ in sizes), 4)
    for v, (picture, (width, height)) in enumerate(zip([p for p, _ in small], sizes, strict=True)):
        pixels[v, :height, :width] = picture
    lines = torch.stack([c.K @ c.viewmat[:3] for _, c in small])
    return Pictures(pixels, torch.tensor(sizes, dtype=torch.float32), lines)


def _looked_at(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of the object's pixels [H, W, 4], every ``EVERY``-th; of its rim, half of which is background,
    none."""
    first = EVERY // 2
    rows, cols = (pixels[first::EVERY, first::EVERY, 3] > 0.9).nonzero(as_tuple=True)
    return rows * EVERY + first, cols * EVERY + first


def _depths(camera: Camera, corners: Tensor) -> Tensor:
    """Depths [D] from the nearest to the farthest corner [8, 3] of a box, as far apart as a pixel is wide in between."""
    z = corners @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    near, far = float(z.min().clamp_min(1e-3 * z.max())), float(z.max())
    pixel = (near + far) / 2 / float(camera.K[[0, 1], [0, 1]].max())
    return torch.linspace(near, far, max(2, math.ceil((far - near) / pixel) + 1))


def _depth_map(camera: Camera, rows: Tensor, cols: Tensor, depth: Tensor) -> Tensor:
    """Depths of the pixels looked at as an image of every ``EVERY``-th pixel, nan where none was."""
    out = torch.full((-(-camera.height // EVERY), -(-camera.width // EVERY)), torch.nan)
    out[rows // EVERY, cols // EVERY] = depth
    return out


def _agreed(points: Tensor, owner: Tensor, cameras: Sequence[Camera], maps: Sequence[tuple[Tensor, float]]) -> Tensor:
    """[N] bool: of the views but the owner's more end at the point than go on through it, and one does at least."""
    votes, ended = torch.zeros(2, len(points), dtype=torch.int64)
    for v, (camera, (depth, beside)) in enumerate(zip(cameras, maps, strict=True)):
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y = (local @ camera.K.T)[:, :2].div(local[:, 2:]).div(EVERY).floor().unbind(1)
        seen = (local[:, 2] > 0) & (x >= 0) & (x < depth.shape[1]) & (y >= 0) & (y < depth.shape[0]) & (owner != v)
        there = depth[y.where(seen, 0).long(), x.where(seen, 0).long()] - local[:, 2]
        here = seen & (there.abs() <= beside)
        ended += here
        votes += here.long() - (seen & (there > beside)).long()
    return (votes >= 0) & (ended > 0)
