#include "bind.h"
#include "cut.h"

namespace p2gs {

void bind_cut(nb::module_& m) {
    m.def(
        "least_cut",
        [](Address neighbours, Address capacity, Address pull, int64_t nodes, int k, Address side) {
            return least_cut({pointer<const int32_t>(neighbours), pointer<int32_t>(capacity), pointer<int32_t>(pull), nodes, k},
                             pointer<uint8_t>(side));
        },
        WithoutGil(),
        "Capacity of the least cut: neighbours int32 [nodes, k], -1 none, neighbour d of a node having it as its neighbour d ^ 1; capacity "
        "int32 [nodes, k] and pull int32 [nodes] (from the source, to the sink where negative), which hold what is left afterwards; side uint8 "
        "[nodes]: 1 the source's, 0 the sink's, 2 either's.");
}

}  // namespace p2gs
