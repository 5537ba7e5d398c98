"""Depth of a surface made of Gaussians: where rays meet the Gaussians' planes, not how far away their middles are.

A ray that grazes a surface of large flat Gaussians meets, in front, tails of Gaussians whose middles are nearer than
the surface is there. Depth composited from middles is off by as much as the Gaussians are large, differently in every
view, and the surface is torn.
"""

from __future__ import annotations

import torch
from torch import Tensor

from p2gs.gaussians.paint import draw
from p2gs.ops import so3
from p2gs.surface.depth_view import camera_rays
from p2gs.types import Camera, GaussianTensors

LEAST_COSINE = 0.05  # between a ray and the mean normal along it
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of coordinates, for their products


def planes(g: GaussianTensors, eye: Tensor) -> Tensor:
    """Unit normals [N, 3] of the planes through the Gaussians' middles in which they are densest along rays from
    ``eye`` [3] past them.

    To first order that is the plane across inverse(covariance) (mean - eye): the flat side of a flat Gaussian, and
    across the ray for a round one (RaDe-GS, arXiv:2406.01467).
    """
    away = g.means - eye
    R = so3.quat_to_matrix(so3.quat_normalize(g.quats))
    along = (R.transpose(1, 2) @ away[..., None])[..., 0]
    sharpest = g.log_scales.amin(1, keepdim=True)  # any common factor will do
    return torch.nn.functional.normalize(
        (R @ (along * torch.exp(2 * (sharpest - g.log_scales)))[..., None])[..., 0], dim=1
    )


def surface_depth(g: GaussianTensors, camera: Camera) -> tuple[Tensor, Tensor]:
    """Depth along z [H, W] at which pixels meet the mean of the Gaussians' planes (PGSR, arXiv:2406.06521), 0 where
    nothing is or the plane is seen edge-on; and how far the planes lie about it, as a standard deviation across the
    surface [H, W]."""
    normal = planes(g, camera.position.to(g.means))
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
