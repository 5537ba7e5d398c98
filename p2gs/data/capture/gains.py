"""Exposure and white balance of each photograph against the others, from the colours of points that several of them
show.

In linear light a photograph is the scene times three numbers (exposure and white balance, red, green, blue). Their
logarithms have mean zero over all photographs of both states, so that the correction has no colour of its own. The
moving parts' points are few and the estimate is a median, so they do not pull it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2gs.data.capture.model import Model
from p2gs.data.exposure import linear

DARK, BRIGHT = 10, 245  # of 255: outside, sensors are not linear
ROUNDS = 10
MIN_POINTS = 15  # photographs that share fewer keep their colours
LIMIT = 1.0  # natural log: a factor of 2.7 either way; more is no exposure difference of one session


def sampled_colours(model: Model, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(row of the point [O], image id [O], log of linear RGB [O, 3]) where the colour can be trusted."""
    import cv2

    rows, images, pixels = model.observations()
    colours = np.full((len(rows), 3), np.nan)
    for key, photo in model.photos.items():
        mine = images == key
        image = cv2.blur(cv2.imread(str(folder / photo.name)), (5, 5))[..., ::-1]
        x = np.clip(pixels[mine, 0].astype(int), 0, image.shape[1] - 1)
        y = np.clip(pixels[mine, 1].astype(int), 0, image.shape[0] - 1)
        colours[mine] = image[y, x]
    good = ((colours > DARK) & (colours < BRIGHT)).all(1)
    return rows[good], images[good], np.log(linear(colours[good] / 255))


def solve_gains(rows: np.ndarray, images: np.ndarray, logs: np.ndarray) -> dict[int, np.ndarray]:
    """Image id -> log gain [3]: the photograph is exp(gain) brighter than the mean one. The gains' mean is zero.

    Alternating medians: a point's colour given the gains, a photograph's gain given the colours.
    """
    keys, image = np.unique(images, return_inverse=True)
    _, point = np.unique(rows, return_inverse=True)
    gains = np.zeros((len(keys), 3))
    for _ in range(ROUNDS):
        colour = _medians(logs - gains[image], point)
        off = logs - colour[point]
        gains = _medians(off, image)
        gains[np.bincount(image) < MIN_POINTS] = 0
        gains = np.clip(gains - gains.mean(0), -LIMIT, LIMIT)
    return {int(k): g for k, g in zip(keys, gains - gains.mean(0), strict=True)}


def _medians(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """[G, 3] the medians of values [N, 3] by group [N]."""
    out = np.zeros((group.max() + 1, values.shape[1]))
    order = np.argsort(group, kind="stable")
    for g, mine in enumerate(np.split(order, np.flatnonzero(np.diff(group[order])) + 1)):
        out[g] = np.median(values[mine], axis=0)
    return out


def photo_gains(model: Model, folder: Path) -> dict[int, np.ndarray]:
    """``solve_gains`` of a model's photographs; zeros for those without enough points."""
    rows, images, logs = sampled_colours(model, folder)
    found = solve_gains(rows, images, logs) if len(rows) else {}
    return {key: found.get(key, np.zeros(3)) for key in model.photos}
