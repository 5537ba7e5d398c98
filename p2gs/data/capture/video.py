"""Sharp frames of a video: three times as many are looked at as are kept, the sharpest of each stretch of time
stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2gs.data.capture.sharpness import MIN_PHOTOS, sharpness
from p2gs.types import UserError

LOOKED_AT = 3  # frames per kept one: a shaken hand is still somewhere in a stretch


def sharp_frames(path: Path, count: int) -> list[tuple[float, np.ndarray]]:
    """(time in seconds, upright RGB [H, W, 3]) of ``count`` frames. Raises UserError where the video cannot be read or
    is too short."""
    import cv2

    video = cv2.VideoCapture(str(path))
    total = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    if not video.isOpened() or total < MIN_PHOTOS:
        raise UserError(f"{path}: cannot be read as a video, or has fewer than {MIN_PHOTOS} frames")
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    bins = np.linspace(0, total, min(count, total) + 1)
    step = max(int((bins[1] - bins[0]) / LOOKED_AT), 1)
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    index = 0
    while video.grab():
        if index % step == 0:
            good, frame = video.retrieve()
            if good:
                which = min(int(np.searchsorted(bins, index, side="right")) - 1, len(bins) - 2)
                score = sharpness(frame)
                if which not in best or score > best[which][0]:
                    best[which] = (score, index, np.ascontiguousarray(frame[..., ::-1]))
        index += 1
    video.release()
    if len(best) < MIN_PHOTOS:
        raise UserError(f"{path}: only {len(best)} frames could be read, expected at least {MIN_PHOTOS}")
    return [(best[k][1] / rate, best[k][2]) for k in sorted(best)]
