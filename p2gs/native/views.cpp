#include "views.h"

#include <algorithm>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

static void in_chunks(decltype(ViewKernels::counts) kernel, const DepthViews& views, const float* points, int64_t size, float* out,
                      int threads) {
    constexpr int64_t kPoints = 2048;  // of a chunk
    struct Context {
        decltype(ViewKernels::counts) kernel;
        const DepthViews& views;
        const float* points;
        int64_t size;
        float* out;
    } context{kernel, views, points, size, out};
    parallel_for(
        int((size + kPoints - 1) / kPoints), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk * kPoints;
            c.kernel(c.views, c.points, c.size, begin, std::min(begin + kPoints, c.size), c.out);
        },
        &context);
}

void depth_counts(const DepthViews& views, const float* points, int64_t size, float* out, int threads) {
    in_chunks(kernels().views.counts, views, points, size, out, threads);
}

void depth_directions(const DepthViews& views, const float* points, int64_t size, float* out, int threads) {
    in_chunks(kernels().views.directions, views, points, size, out, threads);
}

}  // namespace p2gs
