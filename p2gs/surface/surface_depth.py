"""Depth of a surface made of Gaussians, where rays meet their planes (``ops.planes``), and how far these lie apart."""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.gaussians.paint import draw
from p2gs.ops.planes import LEAST_COSINE, planes
from p2gs.ops.rays import camera_rays
from p2gs.types import Camera, GaussianTensors

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of coordinates, for their products


def surface_depth(g: GaussianTensors, camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth along z [H, W] at which pixels meet the mean of the Gaussians' planes (PGSR, arXiv:2406.06521), 0 where
    nothing is or the plane is seen edge-on; and how far the planes lie about it, as a standard deviation across the
    surface [H, W]."""
    normal = planes(g.means, g.quats, g.log_scales, camera.position.to(g.means))[0]
    centre = g.means.mean(0) if len(g) else g.means.new_zeros(3)
    # from planes through the centre: differences of large numbers lose bits
    offset = ((g.means - centre) * normal).sum(1, keepdim=True)
    rotation = camera.viewmat[:3, :3].to(normal)
    n = normal @ rotation.T
    pairs = torch.stack([n[:, i] * n[:, j] for i, j in PAIRS], 1)
    out = draw(g, camera, 0.0, features=torch.cat([n, offset, pairs, n * offset, offset**2], 1))
    mean = out.painted / out.alpha.clamp_min(1e-6)[..., None]
    rays = camera_rays(camera).to(mean)
    origin = rotation @ centre + camera.viewmat[:3, 3].to(mean)
    N, slope = mean[..., :3], (mean[..., :3] * rays).sum(-1)
    met = (out.alpha > 0) & (slope > LEAST_COSINE * rays.norm(dim=-1))
    depth = torch.where(met, (mean[..., 3] + N @ origin) / slope.clamp_min(1e-6), torch.zeros_like(slope))
    p = rays * depth[..., None] - origin
    squares = torch.stack([(1 if i == j else 2) * p[..., i] * p[..., j] for i, j in PAIRS], -1)
    variance = (squares * mean[..., 4:10]).sum(-1) - 2 * (p * mean[..., 10:13]).sum(-1) + mean[..., 13]
    return depth, variance.clamp_min(0).sqrt()
