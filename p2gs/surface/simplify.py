"""Fewer triangles for what is shown, by merging vertices."""

from __future__ import annotations

import numpy as np

from p2gs.ops.mesh import Mesh
from p2gs.ops.unique_rows import unique_rows
from p2gs.surface.tsdf import vertex_normals


def simplify(mesh: Mesh, max_faces: int) -> Mesh:
    """At most about ``max_faces`` triangles: vertices of a grid cell become one, its cells as large as need be."""
    if len(mesh.faces) <= max_faces:
        return mesh
    corner = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    cell = np.sqrt(area / max_faces) * 1.2
    while True:
        out = cluster(mesh, cell)
        if len(out.faces) <= max_faces:
            return out
        cell *= 1.15


def cluster(mesh: Mesh, cell: float) -> Mesh:
    """Vertices merged by cubic cell (mean position and colour); triangles that collapse or double go.

    Vertices that look in different directions stay apart, so that the two sides of a thin wall do not become one.
    """
    normal = vertex_normals(mesh.vertices, mesh.faces)
    rows = np.arange(len(normal))
    side = np.abs(normal).argmax(1)
    side = 2 * side + (normal[rows, side] > 0)
    key = np.c_[np.floor((mesh.vertices - mesh.vertices.min(0)) / cell).astype(np.int64), side]
    _, label = unique_rows(key)
    count = np.bincount(label).astype(float)
    vertices = np.stack([np.bincount(label, mesh.vertices[:, i]) for i in range(3)], 1) / count[:, None]
    colours = np.stack([np.bincount(label, mesh.colours[:, i].astype(float)) for i in range(3)], 1) / count[:, None]
    faces = label[mesh.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    faces = faces[unique_rows(np.sort(faces, 1))[0]]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], renumbered.reshape(-1, 3), colours[used].round().astype(np.uint8))
