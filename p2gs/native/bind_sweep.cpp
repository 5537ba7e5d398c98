#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "sweep.h"

namespace p2gs {

void bind_sweep(nb::module_& m) {
    m.def(
        "sweep",
        [](const std::array<Address, 7>& at, const std::array<int64_t, 4>& shape, int64_t n, float tolerance, Address out,
           int threads) {
            const float* given[7];
            for (int i = 0; i < 7; ++i) given[i] = pointer<const float>(at[i]);
            const Sweep args{given[0], given[1], given[2], given[3], given[4], given[5], given[6],
                             shape[0], shape[1], shape[2], shape[3], tolerance};
            sweep(args, n, pointer<float>(out), threads);
        },
        "addresses (pictures [V, H, W, 4], sizes [V, 2], lines [V, 3, 4], origins, ways, colours, depths), (V, H, W, steps), n, tolerance; "
        "out [n, steps]: how well the views agree with a ray's colour at each depth, 0 to 1.");
}

}  // namespace p2gs
