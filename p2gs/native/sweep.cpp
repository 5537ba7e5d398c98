#include "sweep.h"

#include <algorithm>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

void sweep(const Sweep& args, int64_t n, float* out, int threads) {
    constexpr int64_t kRays = 32;  // of a chunk: neighbours look at the same lines of a picture, which so stay in the cache
    struct Context {
        const Sweep& args;
        int64_t n;
        float* out;
    } context{args, n, out};
    parallel_for(
        int((n + kRays - 1) / kRays), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk * kRays, end = std::min(begin + kRays, c.n), steps = c.args.steps;
            std::fill(c.out + begin * steps, c.out + end * steps, 0.0f);
            kernels().sweep.look(c.args, begin, end, c.out);
            for (int64_t i = begin * steps; i < end * steps; ++i) c.out[i] /= float(c.args.views);
        },
        &context);
}

}  // namespace p2gs
