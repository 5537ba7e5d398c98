#include "landing.h"

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

void check(const Travellers& from) {
    for (int64_t i = 0; i < from.count; ++i)
        if (uint64_t(from.index[i]) >= uint64_t(from.size)) throw std::out_of_range("index of a surfel that does not exist");
}

}  // namespace

void landing_cost(const LandingTables& to, const MotionBatch& motions, const float* thick, bool back, const Travellers& from, float* cost,
                  int64_t* met, int threads) {
    constexpr int64_t kPoints = 512, kMotions = 8;  // of a chunk
    check(from);
    const std::vector<float> matrices = motion_rows(motions, back);
    struct Context {
        decltype(LandingKernels::cost) kernel;
        const LandingTables& to;
        const float *matrices, *thick;
        const Travellers& from;
        int64_t count, blocks;
        float* cost;
        int64_t* met;
    } context{kernels().landing.cost, to, matrices.data(), thick, from, motions.count, (from.count + kPoints - 1) / kPoints, cost, met};
    parallel_for(
        int(context.blocks * ((motions.count + kMotions - 1) / kMotions)), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk % c.blocks * kPoints, first = chunk / c.blocks * kMotions;
            c.kernel(c.to, c.matrices, c.thick, first, std::min(first + kMotions, c.count), c.from, begin, std::min(begin + kPoints, c.from.count),
                     c.cost, c.met);
        },
        &context);
}

void landing_fit(const LandingTables& to, const MotionBatch& motions, const float* basis, const Travellers& from, const PlaneFit& fit,
                 float* A, float* b, int threads) {
    check(from);
    const std::vector<float> matrices = motion_rows(motions, fit.back), rows = motion_rows(motions, false);
    struct Context {
        decltype(LandingKernels::fit) kernel;
        const LandingTables& to;
        const float *matrices, *rows, *basis;
        const Travellers& from;
        const PlaneFit& fit;
        float *A, *b;
    } context{kernels().landing.fit, to, matrices.data(), rows.data(), basis, from, fit, A, b};
    parallel_for(
        int(motions.count), threads,
        [](int m, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            float sums[kFitSums];
            c.kernel(c.to, c.matrices + 12 * m, c.rows + 12 * m, c.basis + 30 * m, c.from, c.fit, sums);
            int k = 0;
            for (int i = 0; i < 5; ++i) {
                for (int j = i; j < 5; ++j, ++k) {
                    c.A[25 * m + 5 * i + j] += sums[k];
                    if (j > i) c.A[25 * m + 5 * j + i] += sums[k];
                }
                c.b[5 * m + i] += sums[15 + i];
            }
        },
        &context);
}

}  // namespace p2gs
