#include "bind.h"
#include "knn.h"

namespace p2gs {

void bind_knn(nb::module_& m) {
    m.def(
        "knn",
        [](Address points, int64_t count, Address queries, int64_t query_count, int k, bool exclude_self, Address distance, Address index,
           int threads) {
            knn(pointer<const float>(points), count, pointer<const float>(queries), query_count, k, exclude_self, pointer<float>(distance),
                pointer<int64_t>(index), threads);
        },
        WithoutGil(),
        "The k nearest of points [count, 3] to queries [query_count, 3] (address 0: the points themselves, each left out of its own "
        "row when exclude_self): distance float32 and index int64 [query_count, k].");
}

}  // namespace p2gs
