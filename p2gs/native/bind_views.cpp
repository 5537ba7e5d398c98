#include "bind.h"
#include "views.h"

namespace p2gs {

void bind_views(nb::module_& m) {
    const auto asked = [](void (*ask)(const DepthViews&, const float*, int64_t, float*, int)) {
        return [ask](Address near, Address far, Address cameras, int height, int width, Address views, int64_t count, float tau,
                     Address points, int64_t size, Address out, int threads) {
            ask({pointer<const float>(near), pointer<const float>(far), pointer<const float>(cameras), height, width,
                 pointer<const int64_t>(views), count, tau},
                pointer<const float>(points), size, pointer<float>(out), threads);
        };
    };
    m.def("depth_counts", asked(depth_counts), WithoutGil(),
          "out [3, size]: how many of views int64 [count] see past each of points [size, 3], see it on a surface, have something in front. "
          "near, far [V, height, width]; cameras [V, 18]: rows of [R | t], fx, fy, cx, cy, width, height of the view.");
    m.def("depth_directions", asked(depth_directions), WithoutGil(),
          "out [3, size]: sum of the unit directions from each point to the cameras that see it on a surface. As depth_counts.");
}

}  // namespace p2gs
