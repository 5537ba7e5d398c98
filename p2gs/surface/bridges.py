"""A part is one body: pieces of its surface that hang apart are joined where nobody saw that nothing is between them.

A table's leg ends under its top, where no camera looks. What was seen of it is a piece of its own, and is neither to be
lost with the crumbs nor to float. Photographs need it: there is nothing behind it. Behind a false surface that hangs in
an opening there is the inside.
"""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh, components
from p2gs.surface.depth_view import DepthView, pixel_matrix, pixels
from p2gs.surface.faces import Faces
from p2gs.surface.pieces import OUT
from p2gs.surface.unseen import NEAR, eyes_of, open_edges, seen_empty

STOPS = (0.25, 0.5, 0.75)  # where it is looked at along a bridge
LOOKS, POINTS = 32, 64  # views, and points of a piece, that are looked at
ENOUGH = 3  # views that see nothing behind a piece


def without_crumbs(
    mesh: Mesh, views: Sequence[DepthView], poses: Sequence[Tensor], voxel: float, share: float = 0.1
) -> Mesh:
    """The connected pieces of at least ``share`` of the largest one's triangles, and smaller ones that photographs need
    (``before_nothing``), but for crumbs that a bridge could cover.

    views, poses ([4, 4] each), voxel: as in ``close_unseen_sides``.
    """
    if not len(mesh.faces):
        return mesh
    label = components(mesh)
    count, area = np.bincount(label), np.bincount(label, Faces(mesh).area)
    kept = count >= share * count.max()
    for k in np.flatnonzero(~kept & (area > (2 * NEAR * voxel) ** 2)):
        kept[k] = before_nothing(mesh.only(label == k), mesh, views, poses, voxel)
    return mesh.only(kept[label])


def before_nothing(piece: Mesh, mesh: Mesh, views: Sequence[DepthView], poses: Sequence[Tensor], voxel: float) -> bool:
    """Whether ``ENOUGH`` views see most of what they see of a piece before space that is seen empty, to the end of the
    ``mesh`` of its part."""
    looked = np.unique(np.linspace(0, len(views) - 1, min(LOOKS, len(views))).round().astype(int))
    middles = piece.vertices[piece.faces].mean(1)
    points = torch.as_tensor(middles[np.linspace(0, len(middles) - 1, min(POINTS, len(middles))).astype(int)])
    lo, hi = (torch.as_tensor(f(mesh.vertices, axis=0)) for f in (np.min, np.max))
    steps = torch.arange(2 * NEAR * voxel, float((hi - lo).norm()), NEAR * voxel, dtype=torch.float64)
    enough = 0
    for i, eye in zip(looked, eyes_of([views[i] for i in looked], [poses[i] for i in looked]), strict=True):
        view = views[i]
        z, pixel = pixels(points.T.contiguous(), pixel_matrix(view.camera, poses[i]).to(points), view.camera)
        depth = torch.cat([view.depth.reshape(-1), view.depth.new_zeros(1)])[pixel]
        shown = points[(depth - z).abs() < NEAR * voxel]
        if not len(shown):
            continue
        behind = shown[:, None] + steps[:, None] * torch.nn.functional.normalize(shown - eye, dim=1)[:, None]
        within = ((behind > lo) & (behind < hi)).all(-1)
        empty = ~within
        empty[within] = seen_empty(behind[within], views, poses, OUT * voxel)
        enough += int(float(empty.all(1).double().mean()) > 0.5)
    return enough >= ENOUGH


def bridged(mesh: Mesh, views: Sequence[DepthView], poses: Sequence[Tensor], voxel: float) -> Mesh:
    """The mesh with its pieces joined to the largest one, in the order of their size: the open end of each goes on as
    it is, along one of the axes, to where it meets the others, if nobody saw that nothing is there. The triangles that
    are added come last."""
    if not len(mesh.faces):
        return mesh
    label, added = components(mesh), []
    order = np.argsort(-np.bincount(label), kind="stable")
    rows = [np.unique(mesh.faces[label == k]) for k in order]
    body = rows[0]
    for k, row in zip(order[1:], rows[1:], strict=True):
        faces = bridge(mesh.only(label == k), mesh.vertices[body], views, poses, voxel)
        added.append(np.concatenate([row, body])[faces])  # the piece's vertices come first
        body = np.concatenate([body, row])
    return Mesh(mesh.vertices, np.concatenate([mesh.faces, *added]), mesh.colours)


def bridge(
    piece: Mesh, body: np.ndarray, views: Sequence[DepthView], poses: Sequence[Tensor], voxel: float
) -> np.ndarray:
    """Triangles [F, 3] from a piece's open edges to the points of ``body`` [N, 3] that they meet along an axis, whose
    numbers go on from the piece's vertices: of the six ways the shortest that nobody saw through, and what is longer by
    ``NEAR`` at most."""
    edges, best = open_edges(piece.faces), (np.inf, np.zeros((0, 3), np.int64))
    if not len(edges) or not len(body):
        return best[1]
    tree = search_tree(body)
    reach = float(np.ptp(piece.vertices, axis=0).max())  # no bridge is longer than what it holds
    for way in (*np.eye(3), *-np.eye(3)):
        length, met = _meets(piece.vertices[edges], way, tree, voxel, min(reach, best[0] + NEAR * voxel))
        rows = np.flatnonzero(np.isfinite(length).all(1))
        stops = piece.vertices[edges[rows]] + np.array(STOPS)[:, None, None, None] * length[rows, :, None] * way
        empty = seen_empty(torch.as_tensor(stops.reshape(-1, 3)), views, poses, OUT * voxel).numpy()
        rows = rows[~empty.reshape(len(STOPS), len(rows), 2).any((0, 2))]
        if not len(rows) or (least := length[rows].min()) >= best[0]:
            continue
        rows = rows[length[rows].max(1) < least + NEAR * voxel]
        (a, b), (d, c) = edges[rows].T, met[rows].T + len(piece.vertices)
        faces = np.concatenate([np.stack(t, 1) for t in ((b, a, d), (b, d, c))])  # round as the piece's are
        best = (least, faces[faces[:, 1] != faces[:, 2]])
    return best[1]


def _meets(ends: np.ndarray, way: np.ndarray, tree, voxel: float, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """How far points [E, 2, 3] go along ``way`` [3] until a point of the body's search ``tree`` is within ``OUT``
    voxels, up to ``reach`` (inf: it never is), and which, [E, 2] each."""
    length, met = np.full(ends.shape[:2], np.inf), np.zeros(ends.shape[:2], np.int64)
    for far in np.arange(0.0, reach, voxel):
        left = np.isinf(length)
        distance, nearest = tree.query(ends[left] + far * way, distance_upper_bound=OUT * voxel)
        length[left] = np.where(np.isfinite(distance), far, np.inf)
        met[left] = np.where(np.isfinite(distance), nearest, 0)
    return length, met
