"""Sides of a mesh that no camera saw: what stands on the floor has an underside, though no photograph shows it.

A mesh from photographs is open where nobody looked. A side of its bounding box which no camera faced is closed by a
plane where space just inside was never seen to be empty, no surface was seen near, and what was seen of the object
reaches down to that plane around it. The plane's rim is drawn to the mesh's open edges. What stands on a plinth is
closed on top of that.
"""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.ops import se3
from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh
from p2gs.ops.unique_rows import unique_rows
from p2gs.surface.depth_view import DepthView, pixel_matrix, pixels, seen_points
from p2gs.surface.plinth import plinth_height

# voxels: a seen surface nearer than this to a side of the box is that side; a plane's rim is drawn as far to open edges
NEAR = 4.0
LEAST = 0.2  # share of a side of the box that must be unseen for it to be closed
FACED = 0.05  # share of the views that may face a side of which it is still said that nobody looked at it
STRAY = 0.03  # share of the views up to which those that see through a place may be wrong: edges, gaps in a lid
RIM = 0.5  # share of the unseen area's rim that must touch seen surface


def seen_empty(points: Tensor, views: Sequence[DepthView], poses: Sequence[Tensor], clearance: float) -> Tensor:
    """[n] whether views, more than a stray one, see surface further than ``clearance`` behind a point, or nothing.
    points [n, 3] float64, start-state coordinates of the part that ``poses`` (start-state coordinates -> world, [4, 4]
    a view) carry."""
    empty, columns = torch.zeros(len(points)), points.T.contiguous()
    for view, T in zip(views, poses, strict=True):
        z, pixel = pixels(columns, pixel_matrix(view.camera, T).to(points), view.camera)
        depth = torch.where(view.labels < 0, torch.full_like(view.depth, torch.inf), view.depth).reshape(-1)
        empty += torch.cat([depth, depth.new_tensor([-torch.inf])])[pixel] - z > clearance
    return empty > STRAY * len(views)


def eyes_of(views: Sequence[DepthView], poses: Sequence[Tensor]) -> Tensor:
    """Where the views' cameras stand in the part's coordinates, [V, 3] float64."""
    return torch.cat(
        [
            se3.apply(se3.inverse(T.double()), v.camera.position.double()[None])
            for v, T in zip(views, poses, strict=True)
        ]
    )


def facing(points: Tensor, outward: Tensor, eyes: Tensor, least: float = 0.2) -> float:
    """Share of the cameras at ``eyes`` [V, 3] that see points [n, 3] of a plane, from their middle, under a cosine with
    its normal ``outward`` [3] of at least ``least``."""
    way = torch.nn.functional.normalize(eyes - points.mean(0), dim=1)
    return float((way @ outward.double() >= least).double().mean())


def close_unseen_sides(
    mesh: Mesh, views: Sequence[DepthView], poses: Sequence[Tensor], part: int, voxel: float, clearance: float
) -> Mesh:
    """The mesh with planes on the unseen sides of its box, sewn to its open edges and coloured as the seen surface
    nearest to them.

    mesh, poses ([4, 4] each): start-state coordinates of the part (its number in ``views``).  voxel: of the mesh.
    clearance: as in ``seen_empty``.
    """
    if len(mesh.faces) == 0:
        return mesh
    # the mesh goes on for a voxel or two beyond the edges of what was seen
    seen = torch.cat([seen_points(v, part, T, stride=2) for v, T in zip(views, poses, strict=True)]).numpy()
    lo, hi = np.quantile(seen, 0.002, axis=0), np.quantile(seen, 0.998, axis=0)
    tree, planes, eyes = search_tree(mesh.vertices), [], eyes_of(views, poses)
    for axis in range(3):
        across = [i for i in range(3) if i != axis]
        shape = [max(2, round((hi[i] - lo[i]) / voxel) + 1) for i in across]
        grid = np.meshgrid(*(np.linspace(lo[i], hi[i], n) for i, n in zip(across, shape, strict=True)), indexing="ij")
        for at, outward in ((lo[axis], -1.0), (hi[axis], 1.0)):
            points = np.full((grid[0].size, 3), at)
            points[:, across] = np.stack([g.ravel() for g in grid], 1)
            if facing(torch.as_tensor(points), outward * torch.eye(3)[axis], eyes) > FACED:
                continue
            points[:, axis] -= outward * plinth_height(mesh, axis, outward, at, hi[axis] - lo[axis], voxel)
            within = points.copy()
            within[:, axis] -= outward * voxel
            solid = ~seen_empty(torch.as_tensor(within), views, poses, clearance).numpy()
            distance = tree.query(points, distance_upper_bound=1.001 * NEAR * voxel)[0]  # infinite beyond
            if (solid & (distance > NEAR * voxel)).mean() < LEAST:
                continue
            area = solid.reshape(shape)
            if _touching(area, (distance < NEAR * voxel).reshape(shape)) >= RIM:
                colours = np.zeros((len(points), 3), mesh.colours.dtype)
                colours[solid] = mesh.colours[tree.query(points[solid])[1]]
                planes.append(grid_plane(points, area, colours, outward * (-1) ** axis))
    for plane in planes:
        mesh = sewn(mesh, plane, NEAR * voxel)
    return mesh


def _touching(area: np.ndarray, seen: np.ndarray) -> float:
    """Share of the rim of an area [a, b] bool at or beside which there is seen surface [a, b] bool."""
    from scipy.ndimage import binary_dilation, binary_erosion

    rim = area & ~np.asarray(binary_erosion(area), dtype=bool)
    return float(binary_dilation(seen)[rim].mean()) if rim.any() else 0.0


def grid_plane(points: np.ndarray, area: np.ndarray, colours: np.ndarray, sign: float) -> Mesh:
    """Two triangles for each grid cell whose corners are all in ``area`` [a, b]; points, colours [a b, 3]. sign: which
    way it faces."""
    index = np.arange(area.size).reshape(area.shape)
    i, j = np.nonzero(area[:-1, :-1] & area[1:, :-1] & area[:-1, 1:] & area[1:, 1:])
    corners = [index[i, j], index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]]
    if sign < 0:
        corners = corners[::-1]
    faces = np.concatenate([np.stack([corners[k] for k in t], 1) for t in ((0, 1, 2), (0, 2, 3))])
    return Mesh(points, faces, colours).without_unused()


def open_edges(faces: np.ndarray) -> np.ndarray:
    """Edges [E, 2] that only one triangle has, each in the direction in which that triangle goes round."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    first, which = unique_rows(np.sort(edges, axis=1))
    return edges[first[np.bincount(which) == 1]]


def sewn(mesh: Mesh, plane: Mesh, reach: float) -> Mesh:
    """Both as one; the plane's rim takes the vertices of the mesh's open edges where these are within ``reach``."""
    rim, edge = np.unique(open_edges(plane.faces)), np.unique(open_edges(mesh.faces))
    index = np.arange(len(plane.vertices)) + len(mesh.vertices)
    if len(rim) and len(edge):
        distance, nearest = search_tree(mesh.vertices[edge]).query(plane.vertices[rim])
        index[rim[distance < reach]] = edge[nearest[distance < reach]]
    faces = index[plane.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    vertices, colours = (np.concatenate(x) for x in ((mesh.vertices, plane.vertices), (mesh.colours, plane.colours)))
    return Mesh(vertices, np.concatenate([mesh.faces, faces]), colours).without_unused()
