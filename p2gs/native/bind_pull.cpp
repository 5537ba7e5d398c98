#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "pull.h"

namespace p2gs {

void bind_pull(nb::module_& m) {
    m.def(
        "part_pulls",
        [](const std::array<Address, 7>& at, Address centres, Address rows, Address starts, int parts, float least, Address out) {
            part_pulls({pointer<const float>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]), pointer<const float>(at[3]),
                        pointer<const float>(at[4]), pointer<const float>(at[5]), pointer<const float>(at[6]), pointer<const double>(centres),
                        pointer<const int64_t>(rows), pointer<const int64_t>(starts), parts, least},
                       pointer<double>(out));
        },
        "out float64 [parts, 6]. addresses: means, quats, their gradients, seen_from [n, 3] (0 = all have a say), turns [parts, 3, 3], eye [3]; "
        "centres float64 [parts, 3]; rows int64 grouped by part, starts int64 [parts + 1]; least cosine.");
}

}  // namespace p2gs
