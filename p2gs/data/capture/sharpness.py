"""How sharp a photograph is, and how many sharp ones a state needs."""

from __future__ import annotations

import numpy as np

MIN_PHOTOS = 8  # of a state


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian of [H, W, 3|4] uint8 at a long edge of 640 px."""
    import cv2

    grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    factor = 640 / max(grey.shape)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())
