"""What training looks at: each view at several sizes, cropped to the object, ready to be composited over any
background.

Pixels are kept premultiplied in uint8 and become float per request, so a scene of 128 views stays under 100 MB.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Optional, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.data.box import mask_bounds
from p2gs.data.images import premultiply, resize_area, resize_depth, to_uint8
from p2gs.ops.pixels import compose
from p2gs.types import Camera, View

MARGIN = 0.03  # beside the mask, of the long edge: a dozen pixels of background at 400


@lru_cache(maxsize=8)
def _permutation(seed: int, epoch: int, n: int) -> np.ndarray:
    return np.random.default_rng([seed % 2**63, epoch]).permutation(n)


def view_index(seed: int, step: int, n_views: int) -> int:
    """Which of n_views the step (counted from 0) looks at: a pure function, each view once in every n_views steps."""
    epoch, i = divmod(step, n_views)
    return int(_permutation(seed, epoch, n_views)[i])


@dataclass(frozen=True)
class TargetImage:
    """A cropped, scaled photograph and the camera that renders it.

    image: [H, W, 3] float32 composited over the background.  alpha: [H, W] float32.  depth: [H, W] float32 along the
    camera's z, 0 where unknown, or None.  key: the same for the same (view, size, crop), hashable.
    """

    image: Tensor
    alpha: Tensor
    depth: Optional[Tensor]
    key: tuple
    camera: Camera


@dataclass(frozen=True)
class _Stored:
    camera: Camera
    colour: Tensor  # [H, W, 3] uint8, premultiplied
    alpha: Tensor  # [H, W] uint8
    depth: Optional[Tensor]  # [H, W] float32
    key: tuple


def crop_window(
    bounds: tuple[int, int, int, int], width: int, height: int, margin: int, align: int
) -> tuple[int, int, int, int]:
    """(x, y, w, h) around bounds (x0, y0, x1, y1) plus margin, w and h multiples of ``align`` where the image is wide
    enough."""

    def span(lo: int, hi: int, size: int) -> tuple[int, int]:
        lo, hi = max(lo - margin, 0), min(hi + margin, size)
        length = min(-(-(hi - lo) // align) * align, size)
        return min(max(lo - (length - (hi - lo)) // 2, 0), size - length), length

    x, w = span(bounds[0], bounds[2], width)
    y, h = span(bounds[1], bounds[3], height)
    return x, y, w, h


class TrainingViews:
    """Views as a pyramid of cropped uint8 images.

    views: as read (any image sizes).  levels: long edge in pixels per pyramid level, in the order in which ``get``
    counts them; a level above a view's own size holds that view at its own size.  margin: pixels around the mask's
    bounding box at the finest level, as a share of the long edge.  align: crops' width and height are multiples of it
    (the rasteriser's tile). crop=False keeps whole images.
    """

    def __init__(
        self,
        views: Sequence[View],
        levels: Sequence[int] = (100, 200, 400),
        margin: float = MARGIN,
        align: int = 16,
        crop: bool = True,
    ):
        self.levels = tuple(levels)
        self._stored = [self._pyramid(v, margin, align, crop) for v in views]

    def __len__(self) -> int:
        return len(self._stored)

    @property
    def has_depth(self) -> bool:
        """Whether one of the views has a depth map."""
        return any(levels[0].depth is not None for levels in self._stored)

    def _pyramid(self, view: View, margin: float, align: int, crop: bool) -> list[_Stored]:
        x0, y0, x1, y1 = mask_bounds(view.alpha)
        pixels = np.zeros((view.camera.height, view.camera.width, 4), np.float32)
        inside = (slice(y0, y1), slice(x0, x1))  # outside the mask premultiplied colour is 0 anyway
        pixels[inside] = premultiply(view.image[inside].numpy(), view.alpha[inside].numpy())
        depth = None if view.depth is None else view.depth.numpy()
        return [self._store(view, pixels, depth, size, margin, align, crop) for size in self.levels]

    @staticmethod
    def _store(view: View, pixels: np.ndarray, depth, size: int, margin: float, align: int, crop: bool) -> _Stored:
        camera = view.camera
        factor = min(1.0, size / max(camera.width, camera.height))
        width, height = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
        if (width, height) != (camera.width, camera.height):
            pixels = resize_area(pixels, width, height)
            depth = None if depth is None else resize_depth(depth, width, height)
            camera = camera.scaled(width, height)
        x, y, w, h = 0, 0, width, height
        if crop:
            bounds = mask_bounds(torch.from_numpy(pixels[..., 3] >= 0.5))
            x, y, w, h = crop_window(bounds, width, height, max(2, round(margin * max(width, height))), align)
        window = (slice(y, y + h), slice(x, x + w))
        shown = torch.from_numpy(to_uint8(pixels[window]))
        return _Stored(
            camera.cropped(x, y, w, h),
            shown[..., :3].contiguous(),
            shown[..., 3].contiguous(),
            None if depth is None else torch.from_numpy(np.ascontiguousarray(depth[window])),
            (view.state, view.split, view.name, width, height, x, y, w, h),
        )

    def spread(self, count: int) -> list[int]:
        """Indices of ``count`` views, evenly from the first to the last (of one: the first); of all views where there
        are no more."""
        return torch.linspace(0, len(self) - 1, min(count, len(self))).round().long().tolist()

    def camera(self, index: int, level: int) -> Camera:
        """The cropped, scaled camera of a view without its pixels."""
        return self._stored[index][level].camera

    def get(self, index: int, level: int, background: Tensor) -> TargetImage:
        """View ``index`` at pyramid level ``level`` composited over ``background`` [3] (float32, 0..1): c + (1 - alpha)
        * background."""
        s = self._stored[index][level]
        image, alpha = compose(s.colour, s.alpha, background)
        return TargetImage(image, alpha, s.depth, s.key, s.camera)
