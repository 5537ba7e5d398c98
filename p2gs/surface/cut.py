"""Which cells of a grid are solid: the least cut between votes for solid and for free space, by faces of one size."""

from __future__ import annotations

import numpy as np

from p2gs.native import native
from p2gs.ops.graph_cut import cut_of_edges

VOTE = 256  # capacity of a whole vote: votes are rounded to this share of one
WAYS = 6  # neighbours of a cell, those along one axis in turn, so that way ^ 1 leads back


def solid_cells(votes: np.ndarray, active: np.ndarray, face: float) -> np.ndarray:
    """The cells [X, Y, Z] bool that are solid: of all sets of active cells the one whose votes against it, with the
    votes for what it leaves out and ``face`` for each of its faces, sum to least (Greig et al. 1989, doi
    10.1111/j.2517-6161.1989.tb01764.x); of several the largest.

    votes: for solid where positive, for free where negative.  active: cells that may be solid; none at the grid's
    border may. face: what a face of a cell costs, in votes.
    """
    count = int(active.sum())
    number = np.full(active.shape, -1, np.int32)
    number[active] = np.arange(count, dtype=np.int32)
    neighbours = np.empty((count, WAYS), np.int32)
    padded = np.pad(number, 1, constant_values=-1)
    for axis in range(3):
        for back in (0, 1):
            shifted = np.roll(padded, (1 if back else -1), axis)[1:-1, 1:-1, 1:-1]
            neighbours[:, 2 * axis + back] = shifted[active]
    cost = round(face * VOTE)
    capacity = np.where(neighbours >= 0, cost, 0).astype(np.int32)
    # a face to a cell that is free for sure is a pull to the sink
    pull = (np.round(votes[active] * VOTE) - cost * (neighbours < 0).sum(1)).astype(np.int32)
    out = np.zeros(active.shape, bool)
    out[active] = least_cut(neighbours, capacity, pull)[1] != 0
    return out


def least_cut(neighbours: np.ndarray, capacity: np.ndarray, pull: np.ndarray) -> tuple[int, np.ndarray]:
    """Capacity of the least cut of a graph, and the side of each node, uint8 [N]: 1 the source's, 0 the sink's, 2
    either's.

    neighbours [N, K] int32, -1 for none: K is even, and neighbour d of a node has it as its neighbour d ^ 1.  capacity
    [N, K] int32: of the edge to each.  pull [N] int32: capacity of the edge from the source, or, where negative, to the
    sink.
    """
    if native is None:
        return least_cut_reference(neighbours, capacity, pull)
    neighbours = np.ascontiguousarray(neighbours, np.int32)
    left, rest = np.array(capacity, np.int32, order="C"), np.array(pull, np.int32)  # of which the kernel takes
    side = np.empty(len(rest), np.uint8)
    addresses = (x.ctypes.data for x in (neighbours, left, rest))
    flow = native.least_cut(*addresses, len(rest), neighbours.shape[1], side.ctypes.data)
    return int(flow), side


def least_cut_reference(neighbours: np.ndarray, capacity: np.ndarray, pull: np.ndarray) -> tuple[int, np.ndarray]:
    """``least_cut`` by scipy's maximum flow."""
    node, way = np.nonzero(neighbours >= 0)
    return cut_of_edges(node, neighbours[node, way], capacity[node, way], pull)
