"""Where a state without depth may start: points on which its photographs agree.

From faint random points training closes dim openings with lids: what is in front becomes opaque first, and a lid
explains a dim inside nearly as well as the inside does. Begun on the inside most of it stays there, and its pictures
are sharper (docs/measured.md#starting-where-photographs-agree). Not in the paper.
"""

from __future__ import annotations

import math
from typing import Sequence

import torch
from torch import Tensor

from p2gs.data.box import mask_bounds
from p2gs.data.images import premultiply, resize_area
from p2gs.ops.rays import camera_rays
from p2gs.ops.sweep import Pictures, agreement
from p2gs.types import Camera, View

SIZES = (64, 128, 32)  # pixels, long edge of the object: small ones tell places, large ones have less noise
EVERY = 2  # one ray for so many pixels of the first size, each way
TOLERANCE = 0.05  # sum over colour and alpha, 0 to 1 each: a few times the noise of such a pixel
BESIDE = 2  # steps of depth within which two views mean one place
SHORT = 0.05  # share of the best votes by which a depth may fall short of them and be as good


def swept_points(views: Sequence[View], box: Tensor) -> tuple[Tensor, Tensor]:
    """Points [N, 3] with colours [N, 3] in 0..1 where rays of the photographs meet what all of them agree on.

    box [2, 3]: of the object, lowest and highest corner; rays are followed through it in steps of a pixel's size. A
    point is left out where rays of more views go on through it than end at it.
    """
    edges = [max(x1 - x0, y1 - y0) / max(v.alpha.shape) for v in views for x0, y0, x1, y1 in [mask_bounds(v.alpha)]]
    share = float(torch.tensor(edges).median())
    scales, cameras = _scaled(views, [size / share for size in SIZES])
    corners = torch.cartesian_prod(*box.T)
    maps, points, colours = [], [], []
    for v, camera in enumerate(cameras):
        rows, cols = _looked_at(scales[0].pixels[v])
        ways, depths = camera_rays(camera)[rows, cols] @ camera.viewmat[:3, :3], _depths(camera, corners)
        eyes = camera.position.expand(len(ways), 3)
        shown = [_look_up(scale, v, (cols + 0.5) / camera.width, (rows + 0.5) / camera.height) for scale in scales]
        agreed = torch.zeros(len(ways), len(depths))
        for scale, colour in zip(scales, shown, strict=True):
            agreed += agreement(scale, eyes, ways, colour, depths, TOLERANCE)
        depth = depths[_nearest(agreed)]
        points.append(eyes + depth[:, None] * ways)
        colours.append(shown[0][:, :3] / shown[0][:, 3:])
        maps.append((_depth_map(camera, rows, cols, depth), BESIDE * float(depths[1] - depths[0])))
    owner, found = torch.cat([torch.full((len(p),), v) for v, p in enumerate(points)]), torch.cat(points)
    kept = ((found >= box[0]) & (found <= box[1])).all(1) & _agreed(found, owner, cameras, maps)
    return found[kept], torch.cat(colours)[kept]


def _nearest(votes: Tensor) -> Tensor:
    """Of the votes [N, D] for depths, the nearest depth's index [N] that is as good as the best (``SHORT``).

    Behind a plain outer wall every photograph that sees the wall still sees it, a little shifted along itself: votes
    stay about as good from the wall on into the body. Three times in ten their best lay behind it, and what starts
    there lines the inside.
    """
    return (votes >= (1 - SHORT) * votes.amax(1, keepdim=True)).byte().argmax(1)


def _scaled(views: Sequence[View], long_edges: Sequence[float]) -> tuple[list[Pictures], list[Camera]]:
    """The photographs, premultiplied colour and alpha in 0..1, scaled down to each of the long edges, none up; the
    cameras of the first."""
    cameras, small = [[] for _ in long_edges], [[] for _ in long_edges]
    for view in views:
        pixels = premultiply(view.image.numpy(), view.alpha.numpy())
        for long_edge, known, shown in zip(long_edges, cameras, small, strict=True):
            camera, share = view.camera, min(1.0, long_edge / max(view.alpha.shape))
            known.append(camera.scaled(*(max(EVERY, round(x * share)) for x in (camera.width, camera.height))))
            shown.append(torch.from_numpy(resize_area(pixels, known[-1].width, known[-1].height)) / 255)
    return [_stacked(shown, known) for shown, known in zip(small, cameras, strict=True)], cameras[0]


def _stacked(shown: Sequence[Tensor], cameras: Sequence[Camera]) -> Pictures:
    """Photographs [H, W, 4], each of its camera's size, as one tensor as large as the largest."""
    sizes = torch.tensor([[c.width, c.height] for c in cameras])
    pixels = torch.zeros(len(shown), *sizes.amax(0).flip(0).tolist(), 4)
    for to, picture in zip(pixels, shown, strict=True):
        to[: len(picture), : picture.shape[1]] = picture
    return Pictures(pixels, sizes.float(), torch.stack([c.K @ c.viewmat[:3] for c in cameras]))


def _look_up(pictures: Pictures, view: int, x: Tensor, y: Tensor) -> Tensor:
    """Colour and alpha [N, 4] of a photograph at places [N] across and down it, 0 to 1."""
    width, height = pictures.sizes[view].long().tolist()
    own = pictures.pixels[view, :height, :width].permute(2, 0, 1)[None]
    at = torch.stack([2 * x - 1, 2 * y - 1], -1)[None, None]
    return torch.nn.functional.grid_sample(own, at, padding_mode="border", align_corners=False)[0, :, 0].T


def _looked_at(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of the object's pixels [H, W, 4], every ``EVERY``-th; of its rim, half of which is background,
    none."""
    first = EVERY // 2
    rows, cols = (pixels[first::EVERY, first::EVERY, 3] > 0.9).nonzero(as_tuple=True)
    return rows * EVERY + first, cols * EVERY + first


def _depths(camera: Camera, corners: Tensor) -> Tensor:
    """Depths [D] from the nearest to the farthest corner [8, 3] of a box, as far apart as a pixel is wide half way."""
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
