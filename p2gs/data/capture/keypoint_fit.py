"""Where photographs show a point, by their pixels: each is laid on the photograph that shows it best.

A detector places a feature by itself in each photograph, to half a pixel, to one where it is seen at a slant. Laid on
one another through the plane about the point, patches tell to a few hundredths (Lindenberger et al. 2021,
arXiv:2108.08291, with learned features; here intensities with a gain and an offset).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from p2gs.data.capture.model import Model
from p2gs.ops.knn import search_tree
from p2gs.types import UserError

REACH = 7  # px: a patch is a square of 15 of its own photograph's pixels
FINE = 3  # looks a side into each pixel of the patch in the better photograph, which shows it larger
PLANE = 12  # points next to one that say how the surface lies there
ITERATIONS = 8
FAR = 2.0  # px that a feature may go
BLOCK = 20_000  # observations at a time, for memory
ALIKE = 0.9  # least correlation of both patches, as of a marker's picture


def refined(model: Model, photos: Path, fixed: np.ndarray) -> tuple[Model, float]:
    """The model with its observations where the photographs' pixels say, and the share of them that moved.

    photos: folder of the photographs' names.  fixed: [n] ids of points that are left as they are.  An observation whose
    patch is not like the best one's stays.
    """
    rows, keys, at, slot = _observations(model, fixed)
    if len(rows) < PLANE:
        return model, 0.0
    grey = {key: _grey(photos / photo.name) for key, photo in model.photos.items()}
    best = np.full(len(rows), -1.0)
    moved = at.copy()
    for normal in (_normals(model), _towards(model)):
        found, likeness = _aligned(model, grey, rows, keys, normal)
        better = likeness > best
        best[better], moved[better] = likeness[better], found[better]
    good = (best > ALIKE) & (np.linalg.norm(moved - at, axis=1) < FAR)
    out = {}
    for key, photo in model.photos.items():
        mine = good & (keys == key)
        xy = photo.xy.copy()
        xy[slot[mine]] = moved[mine]
        out[key] = replace(photo, xy=xy)
    return replace(model, photos=out), float(good.mean())


def _grey(path: Path) -> np.ndarray:
    """[H, W] float32. Raises UserError where the file is no picture."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise UserError(f"{path} cannot be read; expected the copy of a photograph, which --out's .capture holds")
    return image.astype(np.float32)


def _observations(model: Model, fixed: np.ndarray):
    """Point's row, photograph's key, pixel [n, 2] and place among the photograph's features of each observation."""
    rows, keys, at, slot = [], [], [], []
    for key, photo in model.photos.items():
        mine = np.flatnonzero((photo.point >= 0) & ~np.isin(photo.point, fixed))
        rows.append(np.searchsorted(model.ids, photo.point[mine]))
        keys.append(np.full(len(mine), key))
        at.append(photo.xy[mine])
        slot.append(mine)
    return tuple(np.concatenate(x) for x in (rows, keys, at, slot))


def _normals(model: Model) -> np.ndarray:
    """[P, 3] of the plane through each point's neighbours."""
    near = search_tree(model.xyz).query(model.xyz, k=min(PLANE, len(model.xyz)))[1]
    about = model.xyz[near] - model.xyz[near].mean(1, keepdims=True)
    return np.linalg.svd(about, full_matrices=False)[2][:, 2]


def _towards(model: Model) -> np.ndarray:
    """[P, 3] from each point to the middle of the cameras that see it."""
    total = np.zeros_like(model.xyz)
    for photo in model.photos.values():
        rows = np.searchsorted(model.ids, photo.point[photo.point >= 0])
        way = photo.position - model.xyz[rows]
        np.add.at(total, rows, way / np.linalg.norm(way, axis=1, keepdims=True))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _aligned(model: Model, grey: dict, rows, keys, normals) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [n, 2] of the observations after alignment, and how alike the patches are [n] (-1: not seen)."""
    e1 = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(normals, e1)
    centre, J = np.zeros((len(rows), 2)), np.zeros((len(rows), 2, 2))
    for key in model.photos:
        mine = keys == key
        X, r = model.xyz[rows[mine]], rows[mine]
        step = 1e-4 * np.linalg.norm(X - model.photos[key].position, axis=1, keepdims=True)
        centre[mine] = model.pixels_of(key, X)
        J[mine] = np.stack([(model.pixels_of(key, X + step * e[r]) - centre[mine]) / step for e in (e1, e2)], 2)
    size = np.abs(np.linalg.det(J))
    order = np.lexsort((-size, rows))
    seen, first = np.unique(rows[order], return_index=True)
    lead = order[first][np.searchsorted(seen, rows)]
    square = np.arange(-REACH, REACH + 1.0)
    grid = np.stack(np.meshgrid(square, square), -1).reshape(-1, 2)
    within = (np.arange(FINE) - (FINE - 1) / 2) / FINE
    fine = np.stack(np.meshgrid(within, within), -1).reshape(-1, 2)
    solid = size > 1e-3 * size[lead]
    across = J[lead] @ np.linalg.inv(np.where(solid[:, None, None], J, np.eye(2)))  # pixels of the patch to the best's
    template = np.zeros((len(rows), len(grid)), np.float32)
    for key in model.photos:
        mine = np.flatnonzero(keys[lead] == key)
        for offset in fine:
            there = centre[lead[mine], None] + (grid + offset) @ across[mine].transpose(0, 2, 1)
            template[mine] += _sampled(grey[key], there, cv2.INTER_LINEAR)
    template /= len(fine)
    blocks = np.array_split(np.arange(len(rows)), -(-len(rows) // BLOCK))
    done = [_shifts(grey, keys[b], centre[b], grid, template[b]) for b in blocks]
    shift, likeness = (np.concatenate(x) for x in zip(*done, strict=True))
    own = lead == np.arange(len(rows))
    shift[own], likeness[own] = 0, 1
    return centre + shift, np.where(solid, likeness, -1)


def _shifts(grey: dict, keys, centre, grid, template) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton in the frame of the template (Baker and Matthews 2004, DOI 10.1023/B:VISI.0000011205.11775.fd):
    pixels [n, 2] by which each patch lies beside ``centre``, and their correlation [n]."""
    side = 2 * REACH + 1
    square = template.reshape(-1, side, side)
    dy, dx = np.gradient(square, axis=(1, 2))
    A = np.stack([dx.reshape(len(square), -1), dy.reshape(len(square), -1), template, np.ones_like(template)], 2)
    normal = np.einsum("npi,npj->nij", A, A) + 1e-3 * np.eye(4)
    shift, seen = np.zeros((len(keys), 2)), np.zeros_like(template)
    for iteration in range(ITERATIONS + 1):
        for key, image in grey.items():
            mine = np.flatnonzero(keys == key)
            seen[mine] = _sampled(image, centre[mine, None] + shift[mine, None] + grid, cv2.INTER_CUBIC)
        if iteration == ITERATIONS:
            break
        found = np.linalg.solve(normal, np.einsum("npi,np->ni", A, seen)[..., None])[..., 0]
        gain = found[:, 2:3]
        step = -found[:, :2] / np.where(np.abs(gain) > 0.1, gain, np.inf)
        shift += step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1)
    a, b = (x - x.mean(1, keepdims=True) for x in (seen, template))
    return shift, (a * b).sum(1) / np.maximum(np.sqrt((a * a).sum(1) * (b * b).sum(1)), 1e-6)


def _sampled(image: np.ndarray, at: np.ndarray, how: int) -> np.ndarray:
    """[n, P] intensities at pixels ``at`` [n, P, 2] (centres at +0.5).  how: OpenCV's interpolation."""
    x, y = (at[..., i].astype(np.float32) - 0.5 for i in (0, 1))
    parts = [cv2.remap(image, x[i : i + 30000], y[i : i + 30000], how, borderMode=cv2.BORDER_REPLICATE)
             for i in range(0, len(x), 30000)]  # fmt: skip
    return np.concatenate(parts) if parts else np.zeros(x.shape, np.float32)
