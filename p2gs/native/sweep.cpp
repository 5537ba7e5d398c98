#include "sweep.h"

#include <algorithm>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

void sweep(const Sweep& args, int64_t n, int64_t* best, float* agreement, int threads) {
    struct Context {
        const Sweep& args;
        int64_t n, *best;
        float* agreement;
    } context{args, n, best, agreement};
    parallel_for(
        int((n + kSweepRays - 1) / kSweepRays), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk * kSweepRays, end = std::min(begin + kSweepRays, c.n);
            const int64_t steps = c.args.steps;
            std::vector<float> sums(std::size_t(kSweepRays * steps));
            kernels().sweep.look(c.args, begin, end, sums.data());
            for (int64_t i = begin; i < end; ++i) {
                const float* sum = &sums[std::size_t((i - begin) * steps)];
                c.best[i] = std::max_element(sum, sum + steps) - sum;
                c.agreement[i] = sum[c.best[i]] / float(c.args.views);
            }
        },
        &context);
}

}  // namespace p2gs
