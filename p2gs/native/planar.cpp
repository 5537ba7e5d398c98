#include "planar.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

constexpr int64_t kLanes = 16, kColumns = 64;

int64_t reach_of(const int* strides, int count) { return *std::max_element(strides, strides + count); }
int64_t pad_of(const int* strides, int count) { return (reach_of(strides, count) + 2 * kLanes - 1) / kLanes * kLanes; }
int64_t pitch_of(int64_t width, int64_t pad) { return (width + 2 * pad + kLanes - 1) / kLanes * kLanes; }

struct Context {
    PlanarArgs args;
    void (*kernel)(const PlanarArgs&, int64_t, int64_t);
    int64_t n, share;
};

void in_shares(const PlanarArgs& args, void (*kernel)(const PlanarArgs&, int64_t, int64_t), int64_t n, int64_t share, int threads) {
    Context c{args, kernel, n, share};
    parallel_for(int((n + share - 1) / share), threads, [](int chunk, int, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.kernel(c.args, chunk * c.share, std::min((chunk + 1) * c.share, c.n));
    }, &c);
}

}  // namespace

int64_t planar_workspace(int64_t height, int64_t width, const int* strides, int count) {
    const int64_t pitch = pitch_of(width, pad_of(strides, count));
    return height * pitch * (3 + 2 * count) + kLanes;
}

double planar(PlanarArgs a, float* workspace, int threads) {
    a.pad = pad_of(a.strides, a.count), a.pitch = pitch_of(a.width, a.pad);
    // the longest path, 2 strides of 30 contrasts, must stay below 2^31
    a.unit = std::exp2(std::floor(31 - std::log2(60.0 * double(reach_of(a.strides, a.count) + 1))));
    const int64_t plane = a.height * a.pitch;
    a.inverse = workspace;
    for (int i = 0; i < 2; ++i) a.travelled[i] = reinterpret_cast<uint32_t*>(workspace + (1 + i) * plane);
    a.bends = workspace + 3 * plane;
    in_shares(a, kernels().planar.prepare, a.height, kPlanarRows, threads);
    in_shares(a, kernels().planar.travel, a.width, kColumns, threads);
    const int64_t chunks = (a.height + kPlanarRows - 1) / kPlanarRows;
    std::vector<double> sums(size_t(chunks * 4 * a.count));
    a.sums = sums.data();
    in_shares(a, [](const PlanarArgs& a, int64_t begin, int64_t end) {
        kernels().planar.bend(a, begin, end, a.sums + begin / kPlanarRows * 4 * a.count);
    }, a.height, kPlanarRows, threads);
    double value = 0;
    int used = 0;
    std::vector<float> factors(size_t(2 * a.count));
    for (int k = 0; k < 2 * a.count; ++k) {
        if ((k < a.count ? a.width : a.height) <= 2 * a.strides[k % a.count]) continue;
        double weight = 0, bent = 0;
        for (int64_t c = 0; c < chunks; ++c) weight += sums[(c * 2 * a.count + k) * 2], bent += sums[(c * 2 * a.count + k) * 2 + 1];
        value += bent / std::max(weight, 1.0);
        factors[k] = float(1 / std::max(weight, 1.0));
        ++used;
    }
    if (a.v_depth) {
        for (float& f : factors) f /= float(used);
        a.factors = factors.data();
        in_shares(a, kernels().planar.gradient, a.height, kPlanarRows, threads);
    }
    return value / used;
}

}  // namespace p2gs
