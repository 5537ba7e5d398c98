"""Connected components of point sets."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

# points nearer than this, in spacings, lie on one surface: two, and the spacing is the median of an uneven sample
TOUCH = 2.5


def components(points: Tensor, reach: float) -> np.ndarray:
    """Connected component [N] of points [N, 3], joined where they are nearer than ``reach``."""
    pairs = cKDTree(points.numpy()).query_pairs(reach, output_type="ndarray")
    n = len(points)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (n, n))
    return connected_components(graph, directed=False)[1]
