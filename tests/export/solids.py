"""Whether convex pieces intersect, by a linear programme: an oracle for the separating axes that exports go by."""

import numpy as np
from scipy.optimize import linprog

from p2gs.export.physics.convex import Piece


def intersect(a: Piece, b: Piece, margin: float = 0.0) -> bool:
    """Whether two pieces share a ball of radius ``margin`` or more (linear programme for the largest ball in both)."""
    if (a.vertices.min(0) > b.vertices.max(0)).any() or (b.vertices.min(0) > a.vertices.max(0)).any():
        return False
    n, d = (np.concatenate(x) for x in zip(a.planes(), b.planes(), strict=True))
    res = linprog(
        [0, 0, 0, -1], A_ub=np.c_[n, np.ones(len(n))], b_ub=d, bounds=[(None, None)] * 3 + [(0, None)], method="highs"
    )
    return bool(res.status == 0 and res.x[3] > margin)
