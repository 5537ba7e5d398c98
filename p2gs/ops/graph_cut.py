"""The least cut of any graph, by scipy's maximum flow."""

from __future__ import annotations

import numpy as np


def cut_of_edges(tail: np.ndarray, head: np.ndarray, capacity: np.ndarray, pull: np.ndarray) -> tuple[int, np.ndarray]:
    """Capacity of the least cut of a graph, and the side of each node, uint8 [N]: 1 the source's, 0 the sink's, 2
    either's.

    tail, head [E]: an edge's nodes; edges from a node to another add up.  capacity [E]: whole numbers.  pull [N] whole:
    capacity of the edge from the source, or, where negative, to the sink. What a node's edges sum to must be less than
    2^31.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    n = len(pull)
    up, down = np.nonzero(pull > 0)[0], np.nonzero(pull < 0)[0]
    tail = np.r_[tail, np.full(len(up), n), down]
    head = np.r_[head, up, np.full(len(down), n + 1)]
    edges = np.r_[capacity, pull[up], -pull[down]].astype(np.int32)
    graph = csr_matrix((edges, (tail, head)), (n + 2, n + 2))
    result = maximum_flow(graph, n, n + 1)
    left = (graph - result.flow).tocsr()
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    side = np.full(n + 2, 2, np.uint8)
    side[breadth_first_order(left, n, return_predecessors=False)] = 1
    side[breadth_first_order(left.T.tocsr(), n + 1, return_predecessors=False)] = 0
    return int(result.flow_value), side[:n]
