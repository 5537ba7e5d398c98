"""The object's box from its silhouettes, and the scene brought to internal units.

Of a grid around the cameras' common look-at point, what projects into the masks of one state's views is kept (its
visual hull, Laurentini 1994, DOI 10.1109/34.273735); the box holds the hulls of both states.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.types import Camera, Similarity, TwoStateScene, UserError, View

INTERNAL_DIAGONAL = 2.0
CARVE_VIEWS = 32  # per state: more views do not tighten a box
OUTLIER_VIEWS = 0.04  # share of views that may deny a cell before it is carved: one bad mask must not cut the object


def farthest_cameras(positions: np.ndarray, count: int, start: int = 0) -> list[int]:
    """Greedy farthest-point subset of camera positions [N, 3], as sorted indices; all of them where count >= N."""
    n = len(positions)
    if count >= n:
        return list(range(n))
    chosen = [start]
    distance = np.linalg.norm(positions - positions[start], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return sorted(chosen)


def mask_bounds(alpha: Tensor) -> tuple[int, int, int, int]:
    """(x0, y0, x1, y1), exclusive at the upper end, of the pixels with alpha [H, W] > 0; (0, 0, W, H) where there are
    none."""
    inside = alpha.numpy() > 0
    rows = np.flatnonzero(inside.any(axis=1))
    if rows.size == 0:
        return 0, 0, alpha.shape[1], alpha.shape[0]
    cols = np.flatnonzero(inside.any(axis=0))
    return int(cols[0]), int(rows[0]), int(cols[-1]) + 1, int(rows[-1]) + 1


def _sphere(views: Sequence[View]) -> tuple[np.ndarray, float]:
    """Centre and radius of a ball around the object: where the rays through the masks' centres meet, and how wide the
    masks are."""
    A, b, rays = np.zeros((3, 3)), np.zeros(3), []
    for v in views:
        x0, y0, x1, y1 = mask_bounds(v.alpha)
        K, R, o = (
            v.camera.K.double().numpy(),
            v.camera.viewmat[:3, :3].double().numpy(),
            v.camera.position.double().numpy(),
        )
        corners = (
            np.array([[(x0 + x1) / 2, (y0 + y1) / 2, 1], [x0, y0, 1], [x1, y1, 1], [x0, y1, 1], [x1, y0, 1]])
            @ np.linalg.inv(K).T
        )
        d = R.T @ corners[0]
        d /= np.linalg.norm(d)
        P = np.eye(3) - np.outer(d, d)
        A, b = A + P, b + P @ o
        rays.append((o, d, corners))
    centre = np.linalg.lstsq(A, b, rcond=1e-6)[0]
    radii = []
    for o, d, corners in rays:
        distance = max(float((centre - o) @ d), 1e-6)
        widest = np.linalg.norm(corners[1:, :2] - corners[0, :2], axis=1).max() / np.linalg.norm(corners[0])
        radii.append(distance * widest)
    return centre, float(np.quantile(radii, 0.95))


def _carve(views: Sequence[View], lo: np.ndarray, hi: np.ndarray, cells: int) -> np.ndarray:
    """Lower and upper corner [2, 3] of the hull's cells (each as wide as a cell) inside the box lo..hi; [0, 3] where
    none is left."""
    import cv2

    step = (hi - lo) / cells
    axes = [lo[i] + (np.arange(cells) + 0.5) * step[i] for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    votes = np.zeros(len(points), np.int16)
    allowed = int(OUTLIER_VIEWS * len(views))
    half = float(np.linalg.norm(step)) / 2
    for v in views:
        M, K = v.camera.viewmat.numpy(), v.camera.K.numpy()
        cam = points @ M[:3, :3].T + M[:3, 3]
        z = cam[:, 2]
        seen = z > 1e-6
        zs = np.where(seen, z, 1)
        # a cell is inside when its ball touches the mask, so masks grow by the ball's radius in pixels at the mean
        # distance
        grow = int(np.ceil(half * max(K[0, 0], K[1, 1]) / max(float(np.median(zs)), 1e-6)))
        grow = min(grow, max(v.camera.width, v.camera.height) // 4)
        mask = (v.alpha.numpy() > 127).astype(np.uint8)
        mask = np.pad(mask, grow, mode="edge")  # an object cut by the image's border may go on beyond it
        mask = cv2.dilate(mask, np.ones((3, 3), np.uint8), iterations=grow) if grow else mask
        x = np.floor(K[0, 0] * cam[:, 0] / zs + K[0, 2]).astype(np.int64) + grow
        y = np.floor(K[1, 1] * cam[:, 1] / zs + K[1, 2]).astype(np.int64) + grow
        x, y = np.clip(x, 0, mask.shape[1] - 1), np.clip(y, 0, mask.shape[0] - 1)
        votes += seen & (mask[y, x] == 0)
        keep = votes <= allowed
        if keep.sum() < 0.7 * len(points):
            points, votes = points[keep], votes[keep]
        if len(points) == 0:
            return np.empty((0, 3))
    points = points[votes <= allowed]
    return np.stack([points.min(0) - step / 2, points.max(0) + step / 2]) if len(points) else np.empty((0, 3))


def object_box(views: Sequence[View], cells: int = 48) -> Tensor:
    """[2, 3] float32 lower and upper corner of the object in both states, in the views' units.

    Raises UserError where no point of space lies inside the masks of a state's views (cameras or masks are wrong).
    """
    corners = []
    for state in sorted({v.state for v in views}):
        mine = [v for v in views if v.state == state]
        positions = np.stack([v.camera.position.numpy() for v in mine])
        mine = [mine[i] for i in farthest_cameras(positions, CARVE_VIEWS)]
        centre, radius = _sphere(mine)
        box = np.stack([centre - 1.6 * radius, centre + 1.6 * radius])
        for _ in range(2):  # the second pass carves the first one's box with finer cells
            box = _carve(mine, box[0], box[1], cells)
            if len(box) == 0:
                name = ("start", "end")[state]
                raise UserError(
                    f"the masks of state '{name}' show no common object in space; cameras and masks do not belong "
                    "together"
                )
        corners.append(box)
    lo = np.min([c[0] for c in corners], axis=0)
    hi = np.max([c[1] for c in corners], axis=0)
    return torch.from_numpy(np.stack([lo, hi]).astype(np.float32))


def _to_internal(view: View, similarity: Similarity) -> View:
    """x_camera' = s (R x + t) with x = x'/s + c, so R' = R, t' = s (R c + t); K stays, depth is scaled."""
    M = view.camera.viewmat.double().clone()
    M[:3, 3] = similarity.scale * (M[:3, :3] @ M.new_tensor(similarity.center) + M[:3, 3])
    camera = Camera(M.float(), view.camera.K, view.camera.width, view.camera.height)
    return replace(view, camera=camera, depth=None if view.depth is None else view.depth * similarity.scale)


def normalise(scene: TwoStateScene) -> TwoStateScene:
    """The scene in internal units: its box is centred at the origin with a diagonal of 2. ``scene`` must be in input
    units."""
    box = object_box(scene.select(split="train")) if scene.box is None else scene.box
    lo, hi = box.double()
    centre = (lo + hi) / 2
    similarity = Similarity(scale=INTERNAL_DIAGONAL / float((hi - lo).norm()), center=tuple(centre.tolist()))
    views = tuple(_to_internal(v, similarity) for v in scene.views)
    return TwoStateScene(scene.name, views, similarity, similarity.to_internal(box.double()).float())
