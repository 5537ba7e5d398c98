"""How sharp a photograph is, beside its neighbours and by itself, and how many sharp ones a state needs."""

from __future__ import annotations

import numpy as np

MIN_PHOTOS = 8  # of a state
LONG_EDGE = 640  # pixels: the size that photographs are looked at; noise and a sensor's pattern are averaged away
SECOND_BLUR = 2.0  # pixels of LONG_EDGE, sigma: of the order of the blur that is to be told
DIRECTIONS = 4  # of edges: a shaken hand blurs those across its motion only
STRONG = 0.75  # quantile of edges' contrast: above it are outlines and print, below it shadows, which are always soft
BEST = 0.25  # quantile of a direction's edges: much of a sharp photograph may lie out of focus behind the object
TELLING = 0.05  # share of the strong edges that a direction needs to be heard (an even share is 1 / DIRECTIONS)


def _grey(pixels: np.ndarray) -> np.ndarray:
    """[h, w] uint8 of [H, W, 3|4] uint8, long edge at most ``LONG_EDGE``."""
    import cv2

    grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    factor = LONG_EDGE / max(grey.shape)
    return cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else grey


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian of [H, W, 3|4] uint8 at a long edge of 640 px."""
    import cv2

    return float(cv2.Laplacian(_grey(pixels), cv2.CV_64F).var())


def edge_blur(pixels: np.ndarray) -> float:
    """How wide the edges of [H, W, 3|4] uint8 are: sigma in pixels at a long edge of 640 px; 0 where there are none.

    A step of any height that is blurred by sigma loses the share 1 - 1 / R of its slope to a second blur s, with sigma
    = s / sqrt(R^2 - 1) (Zhuo and Sim 2011, doi:10.1016/j.patcog.2011.03.009). So it is a length, whatever the scene
    shows. Each direction of edges is measured, the widest counts. Sharp photographs have 0.6 to 0.9.
    """
    import cv2

    grey = _grey(pixels).astype(np.float32)
    again = cv2.GaussianBlur(grey, (0, 0), SECOND_BLUR)
    (dx, dy), (ex, ey) = ([cv2.Sobel(g, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1))] for g in (grey, again))
    slope, slope_again = np.hypot(dx, dy), np.hypot(ex, ey)
    edges = cv2.Canny(cv2.convertScaleAbs(again), 0, 0, L2gradient=True) > 0  # crests of the slope, however low
    edges &= slope_again > 0
    if not edges.any():
        return 0.0
    edges &= slope_again >= np.quantile(slope_again[edges], STRONG)
    ratio = np.maximum(slope[edges] / slope_again[edges], 1 + 1e-4)  # an edge without end loses nothing
    widths = SECOND_BLUR / np.sqrt(ratio**2 - 1)
    direction = np.rint(np.arctan2(ey, ex)[edges] / (np.pi / DIRECTIONS)).astype(int) % DIRECTIONS
    telling = [widths[direction == d] for d in range(DIRECTIONS)]
    return max(float(np.quantile(w, BEST)) for w in telling if len(w) >= max(TELLING * len(widths), 1))
