#include "evidence.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

void evidence_effective(const PoolState& state, const int64_t* rows, int64_t count, float* out, int threads) {
    constexpr int64_t kRows = 16;  // of a chunk
    struct Context {
        decltype(EvidenceKernels::effective) kernel;
        const PoolState& state;
        const int64_t* rows;
        int64_t count;
        float* out;
    } context{kernels().evidence.effective, state, rows, count, out};
    parallel_for(
        int((count + kRows - 1) / kRows), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            for (int64_t i = chunk * kRows, end = std::min(i + kRows, c.count); i < end; ++i)
                c.kernel(c.state, c.rows[i], c.out + i * c.state.points);
        },
        &context);
}

void evidence_shares(const float* evidence, const float* weights, const uint8_t* loose, const int64_t* rows, int64_t count,
                     int64_t points, float* out) {
    std::vector<double> sums(size_t(count) * 2);
    for (int64_t p = 0; p < points; ++p) {
        int64_t who = 0;
        for (int64_t i = 1; i < count; ++i)
            if (evidence[i * points + p] > evidence[who * points + p]) who = i;
        sums[(loose[rows[who] * points + p] ? count : 0) + who] += double(evidence[who * points + p] * weights[p]);
    }
    std::copy(sums.begin(), sums.end(), out);
}

void evidence_joints(const JointPoints& points, int64_t motions, int64_t few, float* out, int threads) {
    for (int64_t i = 0; i < points.count; ++i)
        if (uint64_t(points.index[i]) >= uint64_t(points.size)) throw std::out_of_range("index of a surfel that does not exist");
    struct Context {
        decltype(EvidenceKernels::joint) kernel;
        const JointPoints& points;
        int64_t few;
        float *out, *away;
    };
    std::vector<float> away(size_t(std::max(threads, 1)) * points.count);
    Context context{kernels().evidence.joint, points, few, out, away.data()};
    parallel_for(
        int(motions), threads,
        [](int b, int thread, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            float *away = c.away + thread * c.points.count, *out = c.out + 4 * b;
            c.kernel(c.points, b, away, out);
            // what is not a number would break the order
            for (int64_t i = 0; i < c.points.count; ++i) away[i] = std::isnan(away[i]) ? INFINITY : away[i];
            out[3] = INFINITY;
            if (c.few > 0 && c.few <= c.points.count) {
                std::nth_element(away, away + c.few - 1, away + c.points.count);
                out[3] = away[c.few - 1];
            }
        },
        &context);
}

}  // namespace p2gs
