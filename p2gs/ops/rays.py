"""Rays through the pixels of a camera."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from p2gs.types import Camera


def camera_rays(camera: Camera) -> Tensor:
    """Directions of unit z through the pixel centres, camera coordinates, [H, W, 3] float32. Not to be written to."""
    return _rays(tuple(camera.K.double().flatten().tolist()), camera.width, camera.height)


@lru_cache(maxsize=2)  # the views of a scene mostly share their intrinsics
def _rays(K: tuple[float, ...], width: int, height: int) -> Tensor:
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1).double()
    return (pixels @ torch.linalg.inv(torch.tensor(K, dtype=torch.float64).reshape(3, 3)).T).float()
