#include "landing.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

// Rows of rotation and translation [B][12] of the motions or their inverses; rotations [B][9] of the motions, where asked for.
std::vector<float> motion_matrices(const MotionBatch& motions, bool back, std::vector<float>* rotations) {
    std::vector<float> out(size_t(motions.count) * 12);
    if (rotations) rotations->resize(size_t(motions.count) * 9);
    for (int64_t b = 0; b < motions.count; ++b) {
        const float* centre = motions.centre + 3 * b;
        const double amount = motions.amount[b], angle = motions.turn[b] ? amount : 0.0, s = std::sin(angle), c = std::cos(angle);
        const double a[3] = {motions.axis[3 * b], motions.axis[3 * b + 1], motions.axis[3 * b + 2]};
        const double cross[3][3] = {{0, -a[2], a[1]}, {a[2], 0, -a[0]}, {-a[1], a[0], 0}};
        const double square = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
        double R[3][3], t[3];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) R[i][j] = (i == j) + s * cross[i][j] + (1 - c) * (a[i] * a[j] - (i == j) * square);
        for (int i = 0; i < 3; ++i)
            t[i] = motions.turn[b] ? centre[i] - (R[i][0] * centre[0] + R[i][1] * centre[1] + R[i][2] * centre[2]) : a[i] * amount;
        for (int i = 0; i < 3; ++i) {
            float* row = out.data() + 12 * b + 4 * i;
            for (int j = 0; j < 3; ++j) {
                row[j] = float(back ? R[j][i] : R[i][j]);
                if (rotations) (*rotations)[9 * b + 3 * i + j] = float(R[i][j]);
            }
            row[3] = float(back ? -(R[0][i] * t[0] + R[1][i] * t[1] + R[2][i] * t[2]) : t[i]);
        }
    }
    return out;
}

void check(const Travellers& from) {
    for (int64_t i = 0; i < from.count; ++i)
        if (uint64_t(from.index[i]) >= uint64_t(from.size)) throw std::out_of_range("index of a surfel that does not exist");
}

}  // namespace

void landing_cost(const LandingTables& to, const MotionBatch& motions, bool back, const Travellers& from, float* cost, int64_t* met,
                  int threads) {
    constexpr int64_t kPoints = 512, kMotions = 8;  // of a chunk
    check(from);
    const std::vector<float> matrices = motion_matrices(motions, back, nullptr);
    struct Context {
        decltype(LandingKernels::cost) kernel;
        const LandingTables& to;
        const float* matrices;
        const Travellers& from;
        int64_t count, blocks;
        float* cost;
        int64_t* met;
    } context{kernels().landing.cost, to, matrices.data(), from, motions.count, (from.count + kPoints - 1) / kPoints, cost, met};
    parallel_for(
        int(context.blocks * ((motions.count + kMotions - 1) / kMotions)), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk % c.blocks * kPoints, first = chunk / c.blocks * kMotions;
            c.kernel(c.to, c.matrices, first, std::min(first + kMotions, c.count), c.from, begin, std::min(begin + kPoints, c.from.count),
                     c.cost, c.met);
        },
        &context);
}

void landing_fit(const LandingTables& to, const MotionBatch& motions, const float* basis, const Travellers& from, const PlaneFit& fit,
                 float* A, float* b, int threads) {
    check(from);
    std::vector<float> rotations;
    const std::vector<float> matrices = motion_matrices(motions, fit.back, &rotations);
    struct Context {
        decltype(LandingKernels::fit) kernel;
        const LandingTables& to;
        const float *matrices, *rotations, *basis;
        const Travellers& from;
        const PlaneFit& fit;
        float *A, *b;
    } context{kernels().landing.fit, to, matrices.data(), rotations.data(), basis, from, fit, A, b};
    parallel_for(
        int(motions.count), threads,
        [](int m, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            float sums[kFitSums];
            c.kernel(c.to, c.matrices + 12 * m, c.rotations + 9 * m, c.basis + 30 * m, c.from, c.fit, sums);
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
