// The least cut of a graph in which every node has up to K neighbours, as cells of a grid have.
#pragma once

#include <cstdint>

namespace p2gs {

// neighbours [nodes][k], -1: none; k is even, and neighbour d of a node has that node as its neighbour d ^ 1.
// capacity [nodes][k]: of the edge to each neighbour; what is left of it afterwards.  pull [nodes]: capacity of the edge from the source,
// or, where negative, to the sink; what is left of it afterwards.
struct CutGraph {
    const int32_t* neighbours;
    int32_t *capacity, *pull;
    int64_t nodes;
    int k;
};

// side [nodes]: 1 where residual edges lead from the source to a node, 0 where they lead from it to the sink, 2 where neither. Both {1} and
// {1, 2} are source sides of a least cut. Returns its capacity. The algorithm of Boykov and Kolmogorov (2004, doi 10.1109/TPAMI.2004.60).
int64_t least_cut(const CutGraph& graph, uint8_t* side);

}  // namespace p2gs
