"""Rays through the pixels of a camera."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from p2gs.types import Camera


def camera_rays(camera: Camera) -> Tensor:
    """Directions of unit z through the pixel centres, camera coordinates, [H, W, 3] float32. Not to be written to."""
    return _rays(tuple(camera.K.double().flatten().tolist()), camera.width, camera.height)


# whole views of a scene mostly share their intrinsics; training crops each in its own way, so it must be quick, too
@lru_cache(maxsize=2)
def _rays(K: tuple[float, ...], width: int, height: int) -> Tensor:
    right, down, first = torch.linalg.inv(torch.tensor(K, dtype=torch.float64).reshape(3, 3)).T
    columns = (torch.arange(width).double() + 0.5)[:, None] * right + first
    rows = (torch.arange(height).double() + 0.5)[:, None] * down
    return (columns + rows[:, None]).float()
