#include "bind.h"
#include "graph.h"

namespace p2gs {

void bind_graph(nb::module_& m) {
    m.attr("graph_columns") = kGraphColumns;
    m.def(
        "graph_average",
        [](Address neighbours, Address weights, int64_t nodes, int k, Address values, int columns, Address out, int threads) {
            graph_average({pointer<const int32_t>(neighbours), pointer<const float>(weights), nodes, k, columns, 0},
                          pointer<const float>(values), pointer<float>(out), threads);
        },
        WithoutGil(), "out [nodes, columns] = weighted sums of rows of values [nodes, columns]: neighbours int32 and weights [nodes, k].");
    m.def(
        "graph_labels",
        [](Address neighbours, Address weights, int64_t nodes, int k, Address cost, int columns, int diffuse, int rounds, float pull,
           float sharp, Address out, int threads) {
            graph_labels({pointer<const int32_t>(neighbours), pointer<const float>(weights), nodes, k, columns, 0},
                         pointer<const float>(cost), {diffuse, rounds, pull, sharp}, pointer<float>(out), threads);
        },
        WithoutGil(),
        "Probabilities out [nodes, columns] of labels that cost [nodes, columns], columns <= graph_columns: diffused, then mean-field.");
}

}  // namespace p2gs
