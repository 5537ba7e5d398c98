"""A marker's corners by its whole picture: the homography that lays the known black and white on the photograph.

A detector takes a corner from the few pixels about it, which are a third of a pixel off where a marker is a dozen
pixels wide; the picture has a hundred pixels of edge. Gauss-Newton on intensities with a gain and an offset (Baker and
Matthews 2004, DOI 10.1023/B:VISI.0000011205.11775.fd).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

BITS = 6  # cells along a marker's side, its black border with it
MARGIN = 0.6  # cells of white about it that are compared too; the next marker is one and a half away
SAMPLES = 36  # along a side
BLUR = 0.6  # px, standard deviation: what a lens and a pixel do to an edge
ITERATIONS = 15
SMALL_STEP = 0.002  # px
FAR = 1.5  # px that a corner may go from where the detector saw it
ALIKE = 0.9  # correlation below which the picture is another one, or is covered


@lru_cache(maxsize=64)
def _cells(marker: int) -> np.ndarray:
    """[BITS + 2, BITS + 2] float64 of 0 and 1 with a white cell all around."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return np.pad(cv2.aruco.generateImageMarker(dictionary, marker, BITS) / 255.0, 1, constant_values=1.0)


def _expected(marker: int, u: np.ndarray, sigma: float) -> np.ndarray:
    """[SAMPLES, SAMPLES] the marker's blurred picture at coordinates ``u`` [SAMPLES] (0 to BITS along its side). sigma:
    in cells."""
    from scipy.special import erf

    edges = np.arange(-1, BITS + 2)  # of the cells, the white ones with them; beyond is white
    step = 0.5 * (1 + erf((u[:, None] - edges[None]) / (np.sqrt(2) * sigma)))
    inside = step[:, :-1] - step[:, 1:]  # [SAMPLES, BITS + 2] how much of each cell the blur sees
    return 1 - inside @ (1 - _cells(marker)) @ inside.T


def fitted(grey: np.ndarray, marker: int, corners: np.ndarray) -> np.ndarray | None:
    """Corners [4, 2] (pixels, centres at +0.5, in ArUco's order) of a marker whose detector saw ``corners``; None where
    the picture does not fit.

    grey: [H, W] float32.
    """
    import cv2

    u = np.linspace(-MARGIN, BITS + MARGIN, SAMPLES)
    x, y = np.meshgrid(u / BITS, u / BITS)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    side = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1).mean()
    expected = _expected(marker, u, BLUR * BITS / max(side, 1.0)).ravel()

    def seen(c: np.ndarray) -> np.ndarray:
        H = cv2.getPerspectiveTransform(unit, c.astype(np.float32)).astype(np.float64)
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        column, row = [((H[i, 0] * x + H[i, 1] * y + H[i, 2]) / w - 0.5).astype(np.float32) for i in (0, 1)]
        return cv2.remap(grey, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float64)

    c = corners.astype(np.float64).copy()
    for _ in range(ITERATIONS):
        now = seen(c)
        J = np.empty((len(now), 10))
        for k in range(8):
            step = np.zeros(8)
            step[k] = 0.05
            J[:, k] = (seen(c + step.reshape(4, 2)) - seen(c - step.reshape(4, 2))) / 0.1
        J[:, 8], J[:, 9] = -expected, -1.0
        solved = np.linalg.lstsq(J, -now, rcond=1e-8)[0]
        move = solved[:8].reshape(4, 2)
        move *= min(1.0, 0.5 / max(float(np.abs(move).max()), 1e-9))
        c += move
        if np.abs(move).max() < SMALL_STEP:
            break
    now = seen(c)
    alike = np.corrcoef(now, expected)[0, 1] if np.ptp(now) > 0 else 0.0
    return c if np.abs(c - corners).max() < FAR and alike > ALIKE else None
