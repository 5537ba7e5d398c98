"""Where up is and how long a metre: from the board, from the floor, else from how people hold a phone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np

from p2gs.data.capture.model import Model

TILT = 25.0  # degrees that the floor's normal may be off the mean picture's up
THICK = 0.01  # a plane's points lie within this share of the cameras' distance
TRIALS = 600
MIN_SHARE = 0.08  # of the points: less is no floor


@dataclass(frozen=True)
class Floor:
    """Points x of the floor: normal . x = height, normal [3] pointing up.  height: None where nothing says how high the
    floor is.  source: of the normal: board, floor plane, or cameras (no plane found)."""

    normal: np.ndarray
    height: Optional[float]
    source: str


def mean_up(model: Model) -> np.ndarray:
    """[3] the pictures' mean up, across the mean direction of view's tilt."""
    up = np.mean([p.up for p in model.photos.values()], axis=0)
    # people tilt a phone down, not sideways: up is what is square to every picture's x axis
    right = np.array([p.viewmat[0, :3] for p in model.photos.values()])
    _, values, Vt = np.linalg.svd(right - 0.0)
    axis = Vt[2] * np.sign(Vt[2] @ up)
    return axis if values[2] < 0.5 * values[1] and axis @ up > 0.5 * np.linalg.norm(up) else up / np.linalg.norm(up)


def fit_plane(points: np.ndarray) -> tuple[np.ndarray, float]:
    """(unit normal [3], offset) of the least-squares plane."""
    centre = points.mean(0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    return normal, float(normal @ centre)


def floor_of(model: Model, seed: int = 0) -> Floor:
    """The lowest large plane that is nearly level; without one the lowest points under the pictures' mean up; without
    points up alone, for no pose says at what height of its frame the floor is."""
    up = mean_up(model)
    if len(model.xyz) == 0:
        return Floor(up, None, "cameras")
    _, distance = model.centre()
    points = model.xyz[np.linalg.norm(model.xyz - np.median(model.xyz, axis=0), axis=1) < 4 * distance]
    best, most, rng = None, 0.0, np.random.default_rng(seed)
    heights = points @ up
    cameras = np.array([p.position for p in model.photos.values()]) @ up
    low = points[heights < np.median(cameras)]
    for _ in range(TRIALS if len(low) >= 20 else 0):
        a, b, c = low[rng.choice(len(low), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) < 1e-12:
            continue
        normal /= np.linalg.norm(normal)
        normal *= np.sign(normal @ up)
        if normal @ up < np.cos(np.radians(TILT)):
            continue
        near = np.abs(low @ normal - normal @ a) < THICK * distance
        below = (low @ normal < normal @ a - 3 * THICK * distance).sum()
        score = near.sum() - 2 * below  # nothing lies under a floor
        if score > most:
            best, most = near, score
    if best is None or most < MIN_SHARE * len(points):
        return Floor(up, float(np.quantile(heights, 0.02)) if len(heights) else None, "cameras")
    normal, offset = fit_plane(low[best])
    sign = float(np.sign(normal @ up))
    return Floor(normal * sign, float(offset * sign), "floor plane")


def to_world(floor: Floor, model: Model, metres_per_unit: float) -> np.ndarray:
    """[4, 4] similarity model -> scene: z up, the floor at 0, what the cameras look at above the origin; at the origin
    where the floor's height is not known."""
    centre, _ = model.centre()
    z = floor.normal
    towards = np.mean([p.position for p in model.photos.values()], axis=0) - centre
    x = towards - (towards @ z) * z  # the cameras' side is +x
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-9 else np.linalg.svd(z[None])[2][1]
    R = np.stack([x, np.cross(z, x), z])
    T = np.eye(4)
    T[:3, :3] = metres_per_unit * R
    foot = centre if floor.height is None else centre - (centre @ z - floor.height) * z
    T[:3, 3] = -T[:3, :3] @ foot
    return T
