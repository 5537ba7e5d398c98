#include <nanobind/stl/array.h>

#include <algorithm>
#include <array>
#include <vector>

#include "bind.h"
#include "fuse.h"

namespace p2gs {

void bind_fuse(nb::module_& m) {
    m.def(
        "fuse_views",
        [](Address maps, Address matrices, int64_t count, int64_t part, const std::array<float, 3>& limits, Address points, int64_t n,
           const std::array<Address, 4>& out, int threads) {
            nb::gil_scoped_release release;
            std::vector<FuseView> views(count);
            for (int64_t k = 0; k < count; ++k) {
                const int64_t* at = pointer<const int64_t>(maps) + 7 * k;
                const float* matrix = pointer<const float>(matrices) + 12 * k;
                FuseView& v = views[k];
                v.depth = pointer<const float>(at[0]), v.label = pointer<const int16_t>(at[1]), v.dot = pointer<const float>(at[2]);
                v.cosine = pointer<const float>(at[3]), v.colour = pointer<const uint8_t>(at[4]);
                v.width = int32_t(at[5]), v.height = int32_t(at[6]);
                std::copy(matrix, matrix + 12, v.to_pixel);
            }
            fuse_views({views.data(), count, part, limits[0], limits[1], limits[2], pointer<const float>(points), pointer<float>(out[0]),
                        pointer<float>(out[1]), pointer<float>(out[2]), pointer<float>(out[3])},
                       n, threads);
        },
        "maps int64 [count, 7]: addresses of a view's depth, int16 labels, |n . ray|, cosine and uint8 colour, width, height; matrices [count, 3, 4] "
        "points to pixels times depth; part; (trunc, behind, weight of a view that sees through); points [n, 3]; out (signed distance [n], "
        "weight of sightings [n], colour [n, 3], weight of all [n])");
}

}  // namespace p2gs
