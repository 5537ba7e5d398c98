"""A small ray tracer for convex primitives: colour, alpha, depth and part ids of one view in numpy.

All rays of a view share their origin, so 1 / direction is computed once per orientation and each primitive only looks
at the rectangle of the image that it projects into.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Sequence

import numpy as np

from p2gs.data.generated.shapes import Primitive, hit_interval, local_normals

KEY_LIGHT = np.array([0.62, -0.34, 0.71])  # directions towards the lights, world coordinates
FILL_LIGHT = np.array([0.39, 0.87, 0.30])
LIGHT_DISTANCE = 8.0


@dataclass(frozen=True)
class Rendering:
    """image [H, W, 3] uint8 straight, alpha [H, W] uint8, depth [H, W] float32 (z of the pixel centre's ray, 0 =
    nothing), parts [H, W] int16 (part of the pixel centre's ray, -1 = nothing)."""

    image: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    parts: np.ndarray


def _window(
    corners: np.ndarray, viewmat: np.ndarray, K: np.ndarray, xs: np.ndarray, ys: np.ndarray
) -> tuple[slice, slice]:
    """Rows and columns of the ray grid (normalised image coordinates ys, xs) that a box with these corners can
    cover."""
    cam = corners @ viewmat[:3, :3].T + viewmat[:3, 3]
    if cam[:, 2].min() <= 1e-3:
        return slice(0, len(ys)), slice(0, len(xs))
    px, py = cam[:, 0] / cam[:, 2], cam[:, 1] / cam[:, 2]
    return slice(*np.searchsorted(ys, [py.min(), py.max()])), slice(*np.searchsorted(xs, [px.min(), px.max()]))


def trace(primitives: Sequence[Primitive], viewmat: np.ndarray, K: np.ndarray, xs: np.ndarray, ys: np.ndarray):
    """Nearest hit of each ray of the grid. xs [W], ys [H]: normalised image coordinates ((u - cx) / fx, (v - cy) / fy).

    Returns depth [H, W] float32 (inf where nothing is hit) and the primitive's index [H, W] int16 (-1).
    """
    depth = np.full((len(ys), len(xs)), np.inf, np.float32)
    index = np.full(depth.shape, -1, np.int16)
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    groups: dict[bytes, list[int]] = {}
    for k, primitive in enumerate(primitives):
        groups.setdefault(np.round(primitive.pose[:3, :3], 9).tobytes(), []).append(k)
    for members in groups.values():
        windows = [_window(primitives[k].corners, viewmat, K, xs, ys) for k in members]
        rows = slice(min(w[0].start for w in windows), max(w[0].stop for w in windows))
        cols = slice(min(w[1].start for w in windows), max(w[1].stop for w in windows))
        if rows.stop <= rows.start or cols.stop <= cols.start:
            continue
        R = primitives[members[0]].pose[:3, :3]
        A = (R.T @ viewmat[:3, :3].T).astype(np.float32)  # local direction = A @ (x, y, 1)
        d = [A[i, 0] * xs[cols][None] + (A[i, 1] * ys[rows] + A[i, 2])[:, None] for i in range(3)]
        for a in d:
            a[np.abs(a) < 1e-9] = 1e-9
        inv = [1 / a for a in d]
        inv_abs = [np.abs(a) for a in inv]
        for k, (r, c) in zip(members, windows, strict=True):
            if r.stop <= r.start or c.stop <= c.start:
                continue
            part = (slice(r.start - rows.start, r.stop - rows.start), slice(c.start - cols.start, c.stop - cols.start))
            p = primitives[k]
            o = ((origin - p.pose[:3, 3]) @ R).astype(np.float32)
            size = np.asarray(p.size, np.float32)
            near, far = hit_interval(
                p.kind, size, o, [a[part] for a in d], [a[part] for a in inv], [a[part] for a in inv_abs]
            )
            z = depth[r, c]
            hit = (near < far) & (near > 0) & (near < z)
            np.copyto(z, near, where=hit)
            np.copyto(index[r, c], np.int16(k), where=hit)
    return depth, index


class Shadow:
    """Where the key light reaches, for one state: the depth map seen from the light (Williams 1978, DOI
    10.1145/965139.807402)."""

    def __init__(self, primitives: Sequence[Primitive], size: int = 1024, bias: float = 0.012):
        corners = np.concatenate([p.corners for p in primitives])
        centre = (corners.min(0) + corners.max(0)) / 2
        forward = -KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        self.R = np.stack([right, np.cross(forward, right), forward])
        self.light = centre - LIGHT_DISTANCE * forward
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = self.R, -self.R @ self.light
        self.reach = np.linalg.norm(corners - centre, axis=1).max() / (LIGHT_DISTANCE - 1)
        self.size, self.bias = size, bias
        grid = (((np.arange(size) + 0.5) / size * 2 - 1) * self.reach).astype(np.float32)
        self.depth = trace(primitives, viewmat, np.eye(3), grid, grid)[0]

    def lit(self, points: np.ndarray) -> np.ndarray:
        """[N] float32 in 0..1 for world points [N, 3]: share of a 3x3 cross of map samples that the light reaches
        past."""
        p = (points - np.float32(self.light)) @ np.float32(self.R.T)
        uv = (p[:, :2] / p[:, 2:] / np.float32(self.reach) + 1) * np.float32(self.size / 2)
        x, y = (np.clip(uv[:, i].astype(np.int32), 2, self.size - 3) for i in (0, 1))
        z = p[:, 2] - np.float32(self.bias)
        cross = ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2))
        return np.sum([(self.depth[y + j, x + i] >= z).astype(np.float32) for i, j in cross], axis=0) / np.float32(5)


def _shade(primitive: Primitive, p_local: np.ndarray, shadow: Optional[Shadow]) -> np.ndarray:
    """[N, 3] colours 0..1 at local surface points: Lambert from two lights and an ambient term that favours the sky."""
    R = primitive.pose[:3, :3].T.astype(np.float32)
    normal = local_normals(primitive.kind, primitive.size, p_local) @ R
    key = np.maximum(normal @ np.float32(KEY_LIGHT / np.linalg.norm(KEY_LIGHT)), 0)
    fill = np.maximum(normal @ np.float32(FILL_LIGHT / np.linalg.norm(FILL_LIGHT)), 0)
    if shadow is not None:
        key = key * shadow.lit(p_local @ R + np.float32(primitive.pose[:3, 3]))
    light = 0.46 + 0.12 * normal[:, 2] + 0.42 * key + 0.14 * fill
    return np.clip(primitive.texture.at(p_local) * light[:, None], 0, 1)


def _grid(K: np.ndarray, width: int, height: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    xs = ((np.arange(width * samples) + 0.5) / samples - K[0, 2]) / K[0, 0]
    ys = ((np.arange(height * samples) + 0.5) / samples - K[1, 2]) / K[1, 1]
    return xs.astype(np.float32), ys.astype(np.float32)


def render(
    primitives: Sequence[Primitive],
    parts: Sequence[int],
    viewmat,
    K,
    width: int,
    height: int,
    samples: int = 2,
    shadow: Optional[Shadow] = None,
) -> Rendering:
    """One view. primitives: posed in the world.  parts: part id of each.  viewmat [4, 4] OpenCV, K [3, 3].

    samples: rays per pixel side (2 = four rays a pixel); depth and part ids are those of the pixel centre's own ray.
    shadow: of the same primitives, or None for none.
    """
    viewmat, K = np.asarray(viewmat, float), np.asarray(K, float)
    xs, ys = _grid(K, width, height, samples)
    depth, index = trace(primitives, viewmat, K, xs, ys)
    colour = np.zeros((*depth.shape, 3), np.float32)
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    flat, z, ids = colour.reshape(-1, 3), depth.ravel(), index.ravel()
    hits = np.flatnonzero(ids >= 0)
    order = hits[np.argsort(ids[hits], kind="stable")]
    ends = np.searchsorted(ids[order], np.arange(len(primitives) + 1))
    for k, p in enumerate(primitives):
        mine = order[ends[k] : ends[k + 1]]
        if len(mine) == 0:
            continue
        A = (p.pose[:3, :3].T @ viewmat[:3, :3].T).astype(np.float32)
        rays = np.stack([xs[mine % len(xs)], ys[mine // len(xs)], np.ones(len(mine), np.float32)], 1)
        o = ((origin - p.pose[:3, 3]) @ p.pose[:3, :3]).astype(np.float32)
        flat[mine] = _shade(p, (rays * z[mine, None]) @ A.T + o, shadow)
    if samples > 1:
        offsets = [(i, j) for i in range(samples) for j in range(samples)]
        count = sum((index[i::samples, j::samples] >= 0).astype(np.int32) for i, j in offsets)
        colour = sum(colour[i::samples, j::samples] for i, j in offsets) / np.maximum(count, 1)[..., None]
        depth, index = trace(primitives, viewmat, K, *_grid(K, width, height, 1))
    else:
        count = (index >= 0).astype(int)
    part_of = np.append(np.asarray(parts, np.int16), np.int16(-1))
    return Rendering(
        np.rint(255 * colour).astype(np.uint8),
        np.rint(255 / samples**2 * count).astype(np.uint8),
        np.where(np.isfinite(depth), depth, 0).astype(np.float32),
        part_of[index],
    )
