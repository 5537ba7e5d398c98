#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <vector>

#include "bind.h"
#include "planar.h"

namespace p2gs {

void bind_planar(nb::module_& m) {
    m.def("planar_workspace", [](int64_t height, int64_t width, const std::vector<int>& strides) {
        return planar_workspace(height, width, strides.data(), int(strides.size()));
    });
    m.def(
        "planar",
        [](const std::array<Address, 7>& at, int64_t height, int64_t width, const std::vector<int>& strides, float contrast, float noise,
           int threads) {
            PlanarArgs a = {};
            a.height = height, a.width = width, a.strides = strides.data(), a.count = int(strides.size());
            a.contrast = contrast, a.noise = noise;
            a.image = pointer<const float>(at[0]), a.target_alpha = pointer<const float>(at[1]);
            a.depth = pointer<const float>(at[2]), a.alpha = pointer<const float>(at[3]);
            a.v_depth = pointer<float>(at[4]), a.v_alpha = pointer<float>(at[5]);
            nb::gil_scoped_release release;
            return planar(a, pointer<float>(at[6]), threads);
        },
        "addresses (photograph [h, w, 3], its alpha, rendered depth and alpha [h, w]; gradients to these two, 0 = none; workspace of "
        "planar_workspace floats), h, w, strides, contrast, noise, threads: mean weighted bend of inverse depth.");
}

}  // namespace p2gs
