"""What a view saw of labelled surfaces, where the surfaces are, and which pixels points fall on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import torch
from torch import Tensor

from p2gs.ops.rays import camera_rays
from p2gs.types import Camera


@dataclass
class DepthView:
    """What one view saw.

    depth [H, W] along z, 0 where nothing was hit.  labels [H, W] int16 part id, -1 where nothing.  colour [H, W, 3]
    uint8.
    """

    camera: Camera
    depth: Tensor
    labels: Tensor
    colour: Tensor
    # [H, W] |n . ray| for a ray of unit z; distance to the surface's plane per unit of depth
    normal_dot: Optional[Tensor] = None
    # [H, W] weight of the sighting: between ray and normal, 0 where the depth has an edge
    cosine: Optional[Tensor] = None


def add_normals(view: DepthView, edge: float) -> DepthView:
    """Fill ``normal_dot`` and ``cosine`` from the depth map. edge: neighbours further apart in depth than this are
    another surface."""
    rays = camera_rays(view.camera)
    p, d = rays * view.depth[..., None], view.depth
    pad = torch.nn.functional.pad(p.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    dx, dy = pad[1:-1, 2:] - pad[1:-1, :-2], pad[2:, 1:-1] - pad[:-2, 1:-1]
    n = torch.nn.functional.normalize(torch.linalg.cross(dx, dy), dim=-1)
    dot = (n * rays).sum(-1).abs()
    # a plane seen at an angle changes depth too: an edge is where both neighbours are off the straight line between
    # them
    near = torch.nn.functional.pad(d[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    bend = torch.maximum(
        (near[1:-1, 2:] + near[1:-1, :-2] - 2 * d).abs(), (near[2:, 1:-1] + near[:-2, 1:-1] - 2 * d).abs()
    )
    hole = (near[1:-1, 2:] == 0) | (near[1:-1, :-2] == 0) | (near[2:, 1:-1] == 0) | (near[:-2, 1:-1] == 0)
    cosine = dot / rays.norm(dim=-1)
    view.normal_dot, view.cosine = (
        dot,
        torch.where((bend > edge) | hole | (d == 0) | (cosine < 0.1), torch.zeros_like(dot), cosine),
    )
    return view


def seen_points(view: DepthView, part: int, start_to_world: Tensor, stride: int = 1) -> Tensor:
    """Where the view saw the part, in the part's start-state coordinates, [M, 3] float64."""
    assert view.cosine is not None  # of add_normals
    mask = (view.labels == part) & (view.cosine > 0)
    if stride > 1:
        keep = torch.zeros_like(mask)
        keep[::stride, ::stride] = True
        mask &= keep
    v, u = mask.nonzero().unbind(1)
    at = torch.stack([u + 0.5, v + 0.5, torch.ones_like(u)], -1).double()
    x = ((at @ torch.linalg.inv(view.camera.K.double()).T).float() * view.depth[mask][:, None]).double()
    M = view.camera.viewmat.double() @ start_to_world
    return (x - M[:3, 3]) @ M[:3, :3]


def pixel_matrix(camera: Camera, T: Tensor) -> Tensor:
    """[3, 4] float64: coordinates that the pose T [4, 4] carries to the world -> pixels times depth."""
    return camera.K.double() @ (camera.viewmat.double() @ T)[:3]


def pixels(columns: Tensor, M: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth [n] and flat pixel [n] of points [3, n] under ``pixel_matrix`` M; the pixel is H W outside the image."""
    width, height = camera.width, camera.height
    p = torch.addmm(M[:, 3:], M[:, :3], columns)
    z = p[2]
    u, v = p[:2] / z.clamp_min(1e-6)
    pixel = v.clamp(0, height - 1).long() * width + u.clamp(0, width - 1).long()
    outside = (z < 1e-4) | (u < 0) | (v < 0) | (u >= width) | (v >= height)
    return z, pixel.masked_fill_(outside, width * height)
