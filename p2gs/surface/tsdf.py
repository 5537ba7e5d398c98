"""Depth maps of a rigid part, fused into a truncated signed distance field and cut by marching cubes.

Each part has its own volume in its start-state pose; views of every state are brought there by the part's motion, so
that what one state hides another shows. Voxels are kept only near seen surface. Curless and Levoy (1996), doi
10.1145/237170.237269, with point-to-plane distances: the difference in depth times the cosine between ray and surface
normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh
from p2gs.surface.depth_view import DepthView, pixel_matrix, seen_points
from p2gs.surface.integrate import integrate

BLOCK = 4  # voxels; active space is kept in cubes of this side


def fuse(
    views: Sequence[DepthView], poses: Sequence[Tensor], part: int, voxel: float, trunc: float, behind: float
) -> Mesh:
    """The part's surface in its start-state pose.

    views: all views, with normals.  poses: start-state coordinates -> world, [4, 4] each.  voxel: side.  trunc:
    distance in front of the surface at which space counts as free.  behind: how far behind the surface it still counts
    (keeps thin panels apart).
    """
    points = [seen_points(v, part, T) for v, T in zip(views, poses, strict=True)]
    if sum(map(len, points)) < 50:
        return Mesh.empty()
    grid = ActiveGrid.around(points, voxel)
    matrices = [pixel_matrix(v.camera, T) for v, T in zip(views, poses, strict=True)]
    field, weight, colour, _ = integrate(grid.centers(), views, matrices, part, trunc, behind)
    return grid.surface(field, weight > 0, colour)


@dataclass
class ActiveGrid:
    """Voxels near seen surface. origin [3] float64: centre of voxel (0, 0, 0); index [M, 3] int64."""

    origin: Tensor
    voxel: float
    shape: tuple[int, int, int]
    index: Tensor

    @staticmethod
    def around(points: Sequence[Tensor], voxel: float) -> "ActiveGrid":
        """All voxels of the blocks that hold a point, and of the blocks beside them. points [n, 3] each, in some of
        them one at least."""
        side = BLOCK * voxel
        points = [p for p in points if len(p)]
        lo = torch.stack([p.amin(0) for p in points]).amin(0) - 1.5 * side

        def block(p: Tensor) -> Tensor:
            return ((p - lo) / side).floor().long()

        dims = (block(torch.stack([p.amax(0) for p in points]).amax(0)) + 2).tolist()
        hit = torch.zeros(dims, dtype=torch.float32)
        for p in points:  # one view's at a time: all together are the most that a run has in memory
            hit[block(p).unbind(1)] = 1
        grown = torch.nn.functional.max_pool3d(hit[None, None], 3, stride=1, padding=1)[0, 0]
        blocks = grown.nonzero()
        inner = torch.stack(torch.meshgrid(*(torch.arange(BLOCK),) * 3, indexing="ij"), -1).reshape(-1, 3)
        index = (blocks[:, None] * BLOCK + inner).reshape(-1, 3)
        return ActiveGrid(lo, voxel, tuple(d * BLOCK for d in dims), index)

    def centers(self) -> Tensor:
        """[M, 3] float32."""
        return (self.origin + self.index.double() * self.voxel).float()

    def surface(self, field: Tensor, seen: Tensor, colour: Tensor) -> Mesh:
        """Zero crossing of field [M] over the cells whose eight corners are seen [M]; colours [M, 3] in 0..1 carried
        along."""
        from scipy.ndimage import map_coordinates
        from skimage.measure import marching_cubes

        i = tuple(self.index[seen].T.numpy())
        dense = np.ones(self.shape, np.float32)
        known = np.zeros(self.shape, bool)
        dense[i], known[i] = field[seen].numpy(), True
        dense, known = fill_pinholes(dense, known)
        # cell[x+1, y+1, z+1]: all corners x..x+1 known, which is where marching_cubes looks for its mask
        cell = known.copy()
        for axis in range(3):
            a, b = [slice(None)] * 3, [slice(None)] * 3
            a[axis], b[axis] = slice(1, None), slice(None, -1)
            shifted = np.zeros_like(cell)
            shifted[tuple(a)] = cell[tuple(a)] & cell[tuple(b)]
            cell = shifted
        if not cell.any() or dense[known].min() >= 0 or dense[known].max() <= 0:
            return Mesh.empty()
        # faces look to where the field is positive
        vertices, faces, _, _ = marching_cubes(dense, 0.0, mask=cell, gradient_direction="descent")
        rgb = np.zeros((len(vertices), 4))
        for c in range(4):
            volume = np.zeros(self.shape, np.float32)
            volume[i] = colour[seen, c].numpy() if c < 3 else 1.0
            rgb[:, c] = map_coordinates(volume, vertices.T, order=1, mode="nearest")
        painted = rgb[:, 3] > 1e-6  # not where pinholes were filled
        rgb = rgb[:, :3] / np.maximum(rgb[:, 3:], 1e-6)
        if painted.any() and not painted.all():
            rgb[~painted] = rgb[painted][search_tree(vertices[painted]).query(vertices[~painted])[1]]
        world = self.origin.numpy() + vertices.astype(np.float64) * self.voxel
        return Mesh(world, faces.astype(np.int64), (np.clip(rgb, 0, 1) * 255).round().astype(np.uint8))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted, [V, 3] unit."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal, face = np.zeros_like(vertices), np.cross(b - a, c - a)
    for i in range(3):
        for axis in range(3):
            normal[:, axis] += np.bincount(faces[:, i], face[:, axis], len(vertices))
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 0, normal / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def fill_pinholes(
    field: np.ndarray, known: np.ndarray, enough: float = 14 / 27, rounds: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Give unknown voxels that most neighbours surround (at least ``enough`` of the 3^3 cube) the known ones' mean.
    field, known: [X, Y, Z].

    Beyond the rim of an open surface a voxel has at most 9 known neighbours, so openings do not shrink.
    """
    from scipy.ndimage import uniform_filter

    for _ in range(rounds):
        share = uniform_filter(known.astype(np.float32), 3, mode="constant")
        mean = uniform_filter(np.where(known, field, 0).astype(np.float32), 3, mode="constant") / np.maximum(
            share, 1e-6
        )
        new = ~known & (share > enough - 1e-3)
        field, known = np.where(new, mean, field), known | new
    return field, known
