#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <array>
#include <utility>

#include "bind.h"
#include "planes.h"

namespace p2gs {
namespace {

Planes planes_of(const std::array<Address, 3>& at, const std::array<float, 3>& eye, const std::array<float, 9>& rotation) {
    Planes out{pointer<const float>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]), {}, {}};
    std::copy(eye.begin(), eye.end(), out.eye);
    std::copy(rotation.begin(), rotation.end(), out.rotation);
    return out;
}

}  // namespace

void bind_planes(nb::module_& m) {
    m.def(
        "plane_features",
        [](const std::array<Address, 3>& at, const std::array<float, 3>& eye, const std::array<float, 9>& rotation, int64_t n, Address out,
           int threads) { plane_features(planes_of(at, eye, rotation), n, pointer<float>(out), threads); },
        "addresses (means, quats, log_scales), eye, rotation world -> camera, n; out [n, 4]: normal in the camera's coordinates, distance.");
    m.def(
        "plane_gradients",
        [](const std::array<Address, 3>& at, const std::array<float, 3>& eye, const std::array<float, 9>& rotation, int64_t n, Address v_out,
           const std::array<Address, 3>& out, int threads) {
            plane_gradients(planes_of(at, eye, rotation), n, pointer<const float>(v_out), pointer<float>(out[0]), pointer<float>(out[1]),
                            pointer<float>(out[2]), threads);
        },
        "The gradients of plane_features by means, quats and log_scales, for v_out [n, 4].");
    m.def(
        "plane_error",
        [](const std::array<Address, 5>& at, int64_t n, float least, float scale, int threads) {
            const PlaneErrorSum sum = plane_error({pointer<const float>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]),
                                                   pointer<const uint8_t>(at[3]), pointer<float>(at[4]), least, scale}, n, threads);
            return std::pair(sum.error, sum.pixels);
        },
        "addresses (features [n, 4], rays [n, 3], target, counted; gradient by features, 0 = none), n, least cosine, scale: sum of log(1 + "
        "|depth - target|) and the pixels that count, or with the gradient's address its gradient times scale.");
}

}  // namespace p2gs
