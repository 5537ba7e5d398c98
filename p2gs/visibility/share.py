"""How much of each Gaussian some view sees.

What fills the inside of a closed body explains no photograph of it, so nothing forms it; carried along when the body
opens, it would stand in the other state's pictures as fog.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from p2gs.ops import so3
from p2gs.render import rasterize
from p2gs.render.base import PIXELS, Pixels, device_of, split_backend
from p2gs.types import Camera, GaussianTensors


def footprint(g: GaussianTensors, camera: Camera, pixels: Pixels = PIXELS["classic"]) -> Tensor:
    """What each Gaussian alone would add to the image's alpha, summed over pixels: opacity * 2 pi sqrt(det of its 2D
    covariance), [N].

    0 for what lies behind the camera. The covariance is the rasterizer's: EWA, ``pixels.eps2d`` added unless opacities
    fall by as much.
    """
    W, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    p = g.means @ W.T + t
    z = p[:, 2].clamp_min(1e-3)
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * p[:, 0] / z**2, zero, fy / z, -fy * p[:, 1] / z**2], -1).reshape(-1, 2, 3)
    P = J @ W @ so3.quat_to_matrix(so3.quat_normalize(g.quats)) * g.log_scales.exp()[:, None, :]
    cov = P @ P.transpose(1, 2)
    added = 0.0 if pixels.antialias else pixels.eps2d
    det = (cov[:, 0, 0] + added) * (cov[:, 1, 1] + added) - cov[:, 0, 1] ** 2
    area = 2 * math.pi * det.clamp_min(0).sqrt() * torch.sigmoid(g.opacity_logits)
    return torch.where(p[:, 2] > 0.01, area, torch.zeros_like(area))


def visible_share(g: GaussianTensors, cameras: list[Camera], backend: str = "auto") -> Tensor:
    """Greatest share of its footprint that any camera sees of each Gaussian (1: nothing in front; 0: hidden
    everywhere), [N] on the CPU.

    A Gaussian's weight in an image, summed over pixels, is the derivative of a feature channel's sum by its feature.
    """
    device = device_of(backend, g.means)  # a phase that is done has its Gaussians on the CPU
    g = g.detach().to(device)
    best = torch.zeros(len(g), device=device)
    features = torch.zeros(len(g), 1, device=device, requires_grad=True)
    _, pixels = split_backend(backend)
    options = {"sh_degree": 0, "features": features, "backend": backend}
    for camera in cameras:
        camera = camera.to(device)
        out = rasterize(
            g.means, g.quats, g.log_scales.exp(), torch.sigmoid(g.opacity_logits), g.sh,
            camera.viewmat, camera.K, camera.width, camera.height, **options,
        )  # fmt: skip
        assert out.features is not None
        (seen,) = torch.autograd.grad(out.features.sum(), features)
        best = torch.maximum(best, seen[:, 0] / footprint(g, camera, pixels).clamp_min(1e-6))
    return best.clamp(0, 1).cpu()
