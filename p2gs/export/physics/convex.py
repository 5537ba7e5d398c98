"""Convex pieces of a surface, for collision: small cells of it, merged while the merged hull encloses little that is
not theirs.

Works on open shells, as scanned surfaces are: a cabinet's shell becomes its panels, a door stays one piece. (Bottom-up
as in Mamou and Ghorbel 2009, doi:10.1109/ICIP.2009.5414068, with grid cells in place of triangles.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np

from p2gs.ops.knn import search_tree
from p2gs.ops.unique_rows import unique_rows

POINTS = 12000  # of the surface that the pieces are made from
# along the longest side; with 12 a twentieth of the hulls is 2.3 % of the diagonal from the surface, with 16 1.5 %
CELLS = 16
CORNERS = 128  # directions whose outermost points make a piece's hull


@dataclass
class Piece:
    """A convex polyhedron. vertices [V, 3] float64, faces [F, 3] int64, outward."""

    vertices: np.ndarray
    faces: np.ndarray

    @property
    def volume(self) -> float:
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)

    def planes(self) -> tuple[np.ndarray, np.ndarray]:
        """Outward normals [F, 3] and offsets [F]: inside is n . x <= d."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        n = np.cross(b - a, c - a)
        n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
        return n, np.einsum("ij,ij->i", n, a)


def thickened(points: np.ndarray, min_thickness: float) -> np.ndarray:
    """Few points [M, 3] whose convex hull is nearly that of the points [N, 3], but at least ``min_thickness`` thick
    everywhere."""
    center = points.mean(0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2] if len(points) >= 3 else np.eye(3)
    local = (points - center) @ axes.T
    for i in range(3):
        lack = min_thickness - np.ptp(local[:, i])
        if lack > 0:
            shift = np.zeros(3)
            shift[i] = lack / 2
            local = np.concatenate([local - shift, local + shift])
    return local[outermost(local)] @ axes + center


def hull(points: np.ndarray, min_thickness: float) -> Piece:
    """Convex hull of points [N, 3], made at least ``min_thickness`` thick across its thinnest direction."""
    import trimesh

    # trimesh sorts out what qhull leaves: merged facets, slivers without a clear side
    mesh = trimesh.convex.convex_hull(thickened(points, min_thickness))
    return Piece(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


def outermost(points: np.ndarray) -> np.ndarray:
    """Indices of the points [N, 3] that are the furthest out in some of ``CORNERS`` directions (a coarse hull), and of
    the box's corners."""
    i = np.arange(CORNERS) + 0.5
    polar, turn = np.arccos(1 - 2 * i / CORNERS), np.pi * (1 + 5**0.5) * i
    directions = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.maximum(
        np.ptp(points, axis=0), 1e-9
    )
    return np.unique(np.concatenate([(points @ d.T).argmax(0) for d in (directions, corners, np.eye(3), -np.eye(3))]))


def spread(vertices: np.ndarray, count: int = POINTS) -> tuple[np.ndarray, float]:
    """About ``count`` of the vertices [V, 3], evenly over the surface, and their spacing: one vertex in each cell of a
    grid."""
    lo, size = vertices.min(0), float(np.ptp(vertices, axis=0).max())
    cell = size / 400
    while True:
        key = np.floor((vertices - lo) / max(cell, 1e-12)).astype(np.int64)
        first = unique_rows(key)[0]
        if len(first) <= count or cell > size:
            points = vertices[np.sort(first)]
            gaps = search_tree(points).query(points, k=2)[0][:, 1] if len(points) > 1 else np.zeros(1)
            return points, max(cell, float(np.quantile(gaps, 0.9)))
        cell *= 1.25


def decompose(
    vertices: np.ndarray, max_pieces: int = 60, waste: float = 2e-4, min_thickness: Optional[float] = None
) -> list[Piece]:
    """Convex pieces that together cover the surface's vertices [N, 3].

    waste: pieces merge while that encloses no more than this fraction of the cube of the size; beyond that only to get
    down to ``max_pieces``.  min_thickness: of a piece, default 1 % of the size.
    """
    from scipy.spatial import ConvexHull

    if len(vertices) < 4:
        return []
    points, spacing = spread(vertices)
    thick = 0.01 * float(np.ptp(points, axis=0).max()) if min_thickness is None else min_thickness
    allowed = waste * float(np.ptp(points, axis=0).max()) ** 3
    keys, cells = cells_of(points, spacing)
    corners = {i: thickened(c, thick) for i, c in enumerate(cells)}
    volumes = {i: ConvexHull(c).volume for i, c in corners.items()}
    apart = np.abs(keys[:, None] - keys[None]).sum(-1) == 1  # cells that share a face
    near = {i: set(np.nonzero(apart[i])[0].tolist()) for i in corners}

    def joined(i: int, j: int) -> tuple[float, float]:
        volume = ConvexHull(np.concatenate([corners[i], corners[j]])).volume
        return volume - volumes[i] - volumes[j], volume

    costs = {(i, j): joined(i, j) for i in corners for j in near[i] if i < j}
    new = len(corners)
    while costs:
        (i, j), (cost, volume) = min(costs.items(), key=lambda item: item[1][0])
        if cost > allowed and len(corners) <= max_pieces:
            break
        around = (near.pop(i) | near.pop(j)) - {i, j}
        costs = {pair: c for pair, c in costs.items() if i not in pair and j not in pair}
        both = np.concatenate([corners.pop(i), corners.pop(j)])
        corners[new], volumes[new], near[new] = both[ConvexHull(both).vertices], volume, around
        for k in around:
            near[k] = (near[k] - {i, j}) | {new}
            costs[(k, new)] = joined(k, new)
        new += 1
    return [hull(c, thick) for c in corners.values()]


def cells_of(points: np.ndarray, spacing: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """The points by cubic cell: keys [C, 3] and the points of each. A point near a wall is in both cells, so that no
    gap is left."""
    size = float(np.ptp(points, axis=0).max()) / CELLS * 1.0001
    lo = (points.min(0) + points.max(0)) / 2 - size * np.ceil(np.ptp(points, axis=0) / size) / 2
    shifts = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.6 * spacing
    limit = np.maximum(np.ceil(np.ptp(points, axis=0) / size).astype(int) - 1, 0)
    keys = np.floor((points[None] + shifts[:, None] - lo) / size).astype(int).clip(0, limit)
    rows = np.c_[keys.reshape(-1, 3), np.tile(np.arange(len(points)), len(shifts))]
    rows = rows[unique_rows(rows)[0]]
    starts = np.r_[0, np.nonzero((np.diff(rows[:, :3], axis=0) != 0).any(1))[0] + 1, len(rows)]
    groups = [rows[a:b] for a, b in zip(starts[:-1], starts[1:], strict=True) if b - a >= 4]
    return np.array([g[0, :3] for g in groups]), [points[g[:, 3]] for g in groups]


def separation(a: Piece, b: Piece) -> tuple[float, np.ndarray, float, float]:
    """How deep two pieces reach into each other (negative: the gap between them is at least that wide), the unit normal
    [3] from a to b along which that is least, and along it the last of a, the first of b. (Separating axes: normals,
    then edge pairs.)"""
    best = _least(a, b, np.concatenate([a.planes()[0], -b.planes()[0]]))
    if best[0] <= 0:
        return best
    edges = [_directions(p) for p in (a, b)]
    axes = np.cross(edges[0][:, None], edges[1][None]).reshape(-1, 3)
    length = np.linalg.norm(axes, axis=1)
    axes = axes[length > 1e-6] / length[length > 1e-6, None]
    if not len(axes):
        return best
    crossed = _least(a, b, np.concatenate([axes, -axes]))
    return min(best, crossed, key=lambda found: found[0])


def _least(a: Piece, b: Piece, axes: np.ndarray) -> tuple[float, np.ndarray, float, float]:
    last, first = (a.vertices @ axes.T).max(0), (b.vertices @ axes.T).min(0)
    i = int((last - first).argmin())
    return float(last[i] - first[i]), axes[i], float(last[i]), float(first[i])


def _directions(piece: Piece) -> np.ndarray:
    """Unit directions [D, 3] of the edges, those that differ by less than a hundredth taken once."""
    pairs = np.unique(
        np.sort(np.concatenate([piece.faces[:, [0, 1]], piece.faces[:, [1, 2]], piece.faces[:, [2, 0]]]), 1), axis=0
    )
    d = piece.vertices[pairs[:, 1]] - piece.vertices[pairs[:, 0]]
    d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
    d *= np.where(d[np.arange(len(d)), np.abs(d).argmax(1)] < 0, -1.0, 1.0)[:, None]
    return d[unique_rows(np.round(d * 100).astype(np.int64))[0]]


def cut(piece: Piece, normal: np.ndarray, offset: float) -> Optional[Piece]:
    """What of a piece lies at normal . x <= offset, normal [3]: itself where that is all, None where it is nothing (or
    flat)."""
    import trimesh

    above = piece.vertices @ normal - offset
    if above.max() <= 0:
        return piece
    pairs = np.unique(
        np.sort(np.concatenate([piece.faces[:, [0, 1]], piece.faces[:, [1, 2]], piece.faces[:, [2, 0]]]), 1), axis=0
    )
    p, q = pairs[(above[pairs[:, 0]] > 0) != (above[pairs[:, 1]] > 0)].T
    share = (above[p] / (above[p] - above[q]))[:, None]
    points = np.concatenate(
        [piece.vertices[above <= 0], piece.vertices[p] + share * (piece.vertices[q] - piece.vertices[p])]
    )
    if (
        len(points) < 4
        or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < 1e-7 * np.ptp(piece.vertices, axis=0).max()
    ):
        return None
    mesh = trimesh.convex.convex_hull(points)
    return Piece(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))
