"""Fewer triangles, by collapsing the edges that move a surface least (quadric errors: Garland and Heckbert 1997, doi
10.1145/258734.258849)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2gs.ops.knn import search_tree
from p2gs.ops.mesh import Mesh

# fast_simplification collapses edges of a squared error below 1e-9 (i + 3)^RISE, in its units, in pass i of PASSES; a
# rise as steep as its default, 7, leaves slivers
RISE, PASSES = 3.0, 100
LARGEST = 0.1  # of the longest side: the error of what may have any, which no surface needs to get near


def simplify(mesh: Mesh, max_faces: int) -> Mesh:
    """About ``max_faces`` triangles where it has more; vertices in the colour of the nearest, no face ``guessed``."""
    if len(mesh.faces) <= max_faces:
        return mesh
    fewer = collapsed(mesh, max_faces, LARGEST * float(np.ptp(mesh.vertices, axis=0).max()))
    return replace(fewer, colours=mesh.colours[search_tree(mesh.vertices).query(fewer.vertices)[1]])


def collapsed(mesh: Mesh, max_faces: int, error: float) -> Mesh:
    """The mesh, black, with about ``max_faces`` triangles where it has more, or as many as keep its surface within
    ``error`` of where it was, in its units."""
    if len(mesh.faces) <= max_faces:
        return Mesh(mesh.vertices, mesh.faces)
    import fast_simplification

    middle = mesh.vertices.mean(0)
    scale = np.sqrt(1e-9 * (PASSES + 2) ** RISE) / error
    points = np.ascontiguousarray((mesh.vertices - middle) * scale)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    found = fast_simplification.simplify(points, faces, target_count=max_faces, agg=RISE)
    vertices = np.asarray(found[0], np.float64) / scale + middle
    return Mesh(vertices, np.asarray(found[1], np.int64)).without_unused()
