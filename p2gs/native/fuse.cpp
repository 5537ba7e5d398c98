#include "fuse.h"

#include <algorithm>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

void fuse_views(const FuseArgs& args, int64_t n, int threads) {
    constexpr int64_t kPoints = 2048;  // of a chunk
    struct Context {
        decltype(FuseKernels::points) kernel;
        const FuseArgs& args;
        int64_t n;
    } context{kernels().fuse.points, args, n};
    parallel_for(
        int((n + kPoints - 1) / kPoints), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk * kPoints;
            c.kernel(c.args, begin, std::min(begin + kPoints, c.n));
        },
        &context);
}

}  // namespace p2gs
