"""A mesh's triangles: where they are, which way they face, how large they are."""

from __future__ import annotations

from typing import Optional

import numpy as np

from p2gs.ops.mesh import Mesh


class Faces:
    """Middles [F, 3], unit normals [F, 3] and areas [F] of a mesh's triangles, in the frame ``axes`` [3, 3] (rows)."""

    def __init__(self, mesh: Mesh, axes: Optional[np.ndarray] = None):
        vertices = mesh.vertices if axes is None else mesh.vertices @ axes.T
        a, b, c = (vertices[mesh.faces[:, i]] for i in range(3))
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1)
        self.middle, self.area = (a + b + c) / 3, length / 2
        self.normal = cross / np.maximum(length, 1e-300)[:, None]


def quantile(values: np.ndarray, weights: np.ndarray, share: float = 0.5) -> float:
    """The value [of N] up to which ``share`` of the weights [N] lie."""
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, share * total[-1])])
