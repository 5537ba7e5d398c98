"""What slides is one piece: pieces of a sliding part between which nobody saw it are joined along its axis.

A blade in its handle, a rod in its tube: photographs show both ends of what slides, and the other parts hide the
stretch between. A rigid part is connected, and what slides through a tight opening has the same section all along, so
the section at the end of one piece goes on to the next. Only surfaces that no view contradicts are added. Not in the
paper.
"""

from __future__ import annotations

from typing import Optional, Sequence

import numpy as np
import torch
from torch import Tensor

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh, connected
from p2gs.ops.unique_rows import unique_rows
from p2gs.surface.depth_view import DepthView
from p2gs.surface.faces import Faces
from p2gs.surface.unseen import NEAR, seen_empty, sewn

LEAST = 0.1  # share of the largest piece's area that a piece has
# interquartile range of a section's length along a piece, in its median, up to which the section is the same all along
ALIKE = 0.6
WITHIN = 3.0  # voxels from a piece's end at which its section is taken: the end itself is ragged
APART = 1.5  # voxels from what was seen to what is added
OUT = 1.5  # voxels by which what is added may stand out of what hides it
MOST = 0.5  # share of it that views may contradict


class Piece:
    """A connected piece of a mesh, as it goes along an axis.  lo, hi: its ends along the axis, without what is thinner
    than half of its section.  ragged: [2], with that.  area: of its surface.  alike: how much its section varies."""

    def __init__(self, mesh: Mesh, axis: np.ndarray, voxel: float):
        self.mesh, self.axis, self.voxel = mesh, axis, voxel
        faces = Faces(mesh)
        self.area, along = float(faces.area.sum()), faces.middle @ axis
        cell = np.floor(along / voxel).astype(int)
        first = cell.min()
        profile = np.bincount(cell - first, faces.area)
        full = np.nonzero(profile > 0.5 * np.median(profile[profile > 0]))[0]
        self.lo, self.hi = (first + full[0]) * voxel, (first + full[-1] + 1) * voxel
        self.ragged = (mesh.vertices @ axis).min(), (mesh.vertices @ axis).max()
        low, middle, high = np.quantile(profile[full[0] : full[-1] + 1], (0.25, 0.5, 0.75))
        self.alike = float((high - low) / middle)

    def section(self, at: float) -> np.ndarray:
        """Line segments [S, 2, 3] in which the plane at ``at`` along the axis cuts it."""
        import trimesh

        mesh = trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False)
        return trimesh.intersections.mesh_plane(mesh, self.axis, at * self.axis)


def bridge(left: Piece, right: Piece, drawn: Piece) -> Optional[Mesh]:
    """What may join two pieces, the left one before the right one along their axis: the section of ``drawn``, one of
    them, from within its end to the other one; None where that is not the same along more of it than the gap, or there
    is no gap."""
    gap, piece = right.ragged[0] - left.ragged[1], drawn
    if gap <= 0 or piece.alike > ALIKE or piece.hi - piece.lo < gap:
        return None
    inset = WITHIN * piece.voxel
    start, end = (left.hi - inset, right.ragged[0]) if piece is left else (right.lo + inset, left.ragged[1])
    lines = piece.section(start)
    # ends that segments share
    first, place = unique_rows(np.round(lines.reshape(-1, 3) / (1e-3 * piece.voxel)).astype(np.int64))
    ring, place = lines.reshape(-1, 3)[first], place.reshape(-1, 2)
    count = max(1, round(abs(end - start) / piece.voxel))
    steps = np.linspace(0, end - start, count + 1)
    points = ring[:, None] + steps[:, None] * piece.axis  # [ends, steps, 3]
    index = np.arange(points[..., 0].size).reshape(len(ring), count + 1)
    near, far, (p, q) = index[:, :-1], index[:, 1:], place.T
    a, b, c, d = near[p], near[q], far[q], far[p]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(points.reshape(-1, 3), faces, np.zeros((points[..., 0].size, 3), np.uint8))


def join_pieces(
    mesh: Mesh, axis: np.ndarray, views: Sequence[DepthView], poses: Sequence[Tensor], voxel: float
) -> Mesh:
    """The mesh of a part that slides along ``axis`` [3], its pieces joined where none of the views saw that nothing is
    between.

    Of two ways the one that they contradict less.  views, poses, voxel: as in ``close_unseen_sides``, of the sliding
    part.
    """
    if len(mesh.faces) == 0:
        return mesh
    pieces = [Piece(p, axis, voxel) for p in connected(mesh)]
    most = max(p.area for p in pieces)
    pieces = sorted((p for p in pieces if p.area > LEAST * most), key=lambda p: p.lo)
    if len(pieces) < 2:
        return mesh
    seen, out = search_tree(mesh.vertices), mesh
    for left, right in zip(pieces, pieces[1:], strict=False):
        ways = []
        for added in (bridge(left, right, drawn) for drawn in (left, right)):
            if added is not None:
                middle = added.vertices[added.faces].mean(1)
                empty = seen_empty(torch.as_tensor(middle), views, poses, OUT * voxel).numpy()
                ways.append((empty.mean(), added, (seen.query(middle)[0] > APART * voxel) & ~empty))
        contradicted, added, keep = min(ways, key=lambda way: way[0], default=(1.0, None, None))
        if contradicted < MOST and keep.any():
            added = Mesh(added.vertices, added.faces[keep], mesh.colours[seen.query(added.vertices)[1]])
            out = sewn(out, added.without_unused(), NEAR * voxel)
    return out
