#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "carry.h"

namespace p2gs {

void bind_carry(nb::module_& m) {
    m.def(
        "carry",
        [](const std::array<Address, 6>& at, int bases, Address rows, Address starts, Address transforms, Address tables, int parts,
           int threads) {
            nb::gil_scoped_release release;
            carry({pointer<const float>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]), pointer<float>(at[3]),
                   pointer<float>(at[4]), pointer<float>(at[5]), pointer<const int64_t>(rows), bases},
                  pointer<const float>(transforms), pointer<const double>(tables), pointer<const int64_t>(starts), parts, threads);
        },
        "addresses (means [n, 3], quats [n, 4], sh [n, bases, 3], and the same after the motions), bases, rows int64 grouped by part, starts "
        "int64 [parts + 1] of the parts' rows, transforms [parts, 4, 4], tables float64 of the bands, parts, threads; other rows stay");
}

}  // namespace p2gs
