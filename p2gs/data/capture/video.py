"""Sharp frames of a video: three times as many are looked at as are kept, the sharpest of each stretch of time
stays."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from p2gs.data.capture.sharpness import MIN_PHOTOS, sharpness
from p2gs.types import UserError

LOOKED_AT = 3  # frames per kept one: a shaken hand is still somewhere in a stretch


def sharp_frames(path: Path, count: int) -> Iterator[tuple[float, np.ndarray]]:
    """(time in seconds, upright RGB [H, W, 3] uint8) of ``count`` frames, one after the other: sixty of a 4K video
    together would take 1.5 GB. Raises UserError where the video cannot be read or is too short."""
    import cv2

    video = cv2.VideoCapture(str(path))
    total = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    if not video.isOpened() or total < MIN_PHOTOS:
        raise UserError(f"{path}: cannot be read as a video, or has fewer than {MIN_PHOTOS} frames")
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    bins = np.linspace(0, total, min(count, total) + 1)
    step = max(int((bins[1] - bins[0]) / LOOKED_AT), 1)
    best: tuple[int, float, int, np.ndarray] | None = None  # stretch, sharpness, index, frame
    index, given = 0, 0
    while video.grab():
        frame = video.retrieve()[1] if index % step == 0 else None
        if frame is not None:
            which = min(int(np.searchsorted(bins, index, side="right")) - 1, len(bins) - 2)
            if best is not None and best[0] != which:
                yield best[2] / rate, best[3]
                best, given = None, given + 1
            frame = np.ascontiguousarray(frame[..., ::-1])
            score = sharpness(frame)
            if best is None or score > best[1]:
                best = (which, score, index, frame)
        index += 1
    video.release()
    if best is not None:
        yield best[2] / rate, best[3]
        given += 1
    if given < MIN_PHOTOS:
        raise UserError(f"{path}: only {given} frames could be read, expected at least {MIN_PHOTOS}")
