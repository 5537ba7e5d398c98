#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "image.h"

namespace p2gs {

void bind_image(nb::module_& m) {
    m.def(
        "cross_entropy",
        [](Address pred, Address target, Address grad, int64_t n, float low, float high, float factor, int threads) {
            return cross_entropy({pointer<const float>(pred), pointer<const float>(target), pointer<float>(grad), low, high, factor / float(n)}, n,
                                 threads) / double(n);
        },
        WithoutGil(), "Mean binary cross-entropy of pred clamped to [low, high], n floats each; with `grad`, its gradient times factor goes there.");
    m.def(
        "depth_spread",
        [](const std::array<Address, 7>& at, int64_t n, float ref, float per_knee, float factor, int threads) {
            const float* target = pointer<const float>(at[3]);
            const int64_t count = count_inside(target, n);
            const double weight = 1.0 / double(count ? count : 1);
            nb::gil_scoped_release release;
            return weight * depth_spread({pointer<const float>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]), target,
                                          pointer<float>(at[4]), pointer<float>(at[5]), pointer<float>(at[6]), ref, factor * float(weight), per_knee},
                                         n, threads);
        },
        "addresses (alpha, depth, depth_sq, target alpha; gradients to the first three, 0 = none), n, ref, 1 / knee^2, factor, threads: "
        "mean over the pixels with target alpha above one half of v / (1 + v / knee^2), v = alpha depth_sq - (depth - ref alpha)^2, or "
        "its gradients times factor.");
    m.def(
        "compose",
        [](Address colour, Address alpha8, Address image, Address alpha, const std::array<float, 3>& background, int64_t n, int threads) {
            compose({pointer<const uint8_t>(colour), pointer<const uint8_t>(alpha8), pointer<float>(image), pointer<float>(alpha),
                     {background[0], background[1], background[2]}},
                    n, threads);
        },
        WithoutGil(), "Premultiplied bytes colour [n, 3] and alpha [n] over a background: image float [n, 3] and alpha float [n].");
}

}  // namespace p2gs
