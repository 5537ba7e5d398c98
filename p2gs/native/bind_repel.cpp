#include "bind.h"
#include "repel.h"

namespace p2gs {

void bind_repel(nb::module_& m) {
    m.def(
        "repel_local",
        [](Address points, int64_t n, Address sources, int64_t count, float radius, float eps, float exponent, bool mean, Address pull,
           Address slope, int threads) {
            RepelArgs a = {};
            a.points = pointer<const float>(points), a.n = n;
            a.radius = radius, a.eps = eps, a.exponent = exponent, a.mean = mean;
            a.pull = pointer<float>(pull), a.slope = pointer<float>(slope);
            repel_local(a, pointer<const float>(sources), count, threads);
        },
        WithoutGil(),
        "Mean (or summed) pull [n, 3] of the sources [count, 3] within the radius of points [n, 3], and its slope by the point [n, 6]: xx, yy, zz, xy, "
        "xz, yz.");
}

}  // namespace p2gs
