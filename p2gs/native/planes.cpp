#include "planes.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "pool.h"

namespace p2gs {
namespace {

constexpr int64_t kChunk = 1 << 11;

// fn(begin, end, chunk) over chunks of n.
template <class F>
void over_chunks(int64_t n, int threads, F&& fn) {
    struct Context {
        F& fn;
        int64_t n;
    } c{fn, n};
    parallel_for(int((n + kChunk - 1) / kChunk), threads, [](int chunk, int, void* p) {
        Context& c = *static_cast<Context*>(p);
        c.fn(chunk * kChunk, std::min((chunk + 1) * kChunk, c.n), chunk);
    }, &c);
}

// One Gaussian's plane: R its rotation, along the way from the eye to its middle in its own frame, normal in that frame.
struct Plane {
    float q[4], length, R[9], along[3], factor[3], unit[3], norm;

    Plane(const Planes& a, int64_t i) {
        const float *m = a.means + 3 * i, *s = a.log_scales + 3 * i;
        length = 0;
        for (int k = 0; k < 4; ++k) length += a.quats[4 * i + k] * a.quats[4 * i + k];
        length = std::max(std::sqrt(length), 1e-12f);
        for (int k = 0; k < 4; ++k) q[k] = a.quats[4 * i + k] / length;
        const float w = q[0], x = q[1], y = q[2], z = q[3];
        const float rows[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
                               2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
        std::copy(rows, rows + 9, R);
        const float away[3] = {m[0] - a.eye[0], m[1] - a.eye[1], m[2] - a.eye[2]};
        const float sharpest = std::min({s[0], s[1], s[2]});  // any common factor will do
        norm = 0;
        for (int k = 0; k < 3; ++k) {
            along[k] = R[k] * away[0] + R[3 + k] * away[1] + R[6 + k] * away[2];
            factor[k] = std::exp(2 * (sharpest - s[k]));
            unit[k] = along[k] * factor[k];
            norm += unit[k] * unit[k];
        }
        norm = std::max(std::sqrt(norm), 1e-12f);
        for (float& u : unit) u /= norm;
    }
};

}  // namespace

void plane_features(const Planes& a, int64_t n, float* out, int threads) {
    over_chunks(n, threads, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            const Plane p(a, i);
            float world[3];
            for (int r = 0; r < 3; ++r) world[r] = p.R[3 * r] * p.unit[0] + p.R[3 * r + 1] * p.unit[1] + p.R[3 * r + 2] * p.unit[2];
            for (int r = 0; r < 3; ++r)
                out[4 * i + r] = a.rotation[3 * r] * world[0] + a.rotation[3 * r + 1] * world[1] + a.rotation[3 * r + 2] * world[2];
            out[4 * i + 3] = p.unit[0] * p.along[0] + p.unit[1] * p.along[1] + p.unit[2] * p.along[2];
        }
    });
}

void plane_gradients(const Planes& a, int64_t n, const float* v_out, float* v_means, float* v_quats, float* v_log_scales, int threads) {
    over_chunks(n, threads, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            const Plane p(a, i);
            const float *v = v_out + 4 * i, *m = a.means + 3 * i;
            const float away[3] = {m[0] - a.eye[0], m[1] - a.eye[1], m[2] - a.eye[2]};
            float v_world[3], v_unit[3], v_R[9], v_along[3];
            for (int r = 0; r < 3; ++r) v_world[r] = a.rotation[r] * v[0] + a.rotation[3 + r] * v[1] + a.rotation[6 + r] * v[2];
            float slope = 0;
            for (int k = 0; k < 3; ++k) {
                v_unit[k] = p.R[k] * v_world[0] + p.R[3 + k] * v_world[1] + p.R[6 + k] * v_world[2] + v[3] * p.along[k];
                slope += v_unit[k] * p.unit[k];
            }
            for (int k = 0; k < 3; ++k) {
                const float v_scaled = (v_unit[k] - slope * p.unit[k]) / p.norm;  // by along * factor
                v_along[k] = v_scaled * p.factor[k] + v[3] * p.unit[k];
                // the common factor has no say: what the sharpest axis would get by it sums to zero
                v_log_scales[3 * i + k] = -2 * v_scaled * p.unit[k] * p.norm;
            }
            for (int r = 0; r < 3; ++r) {
                v_means[3 * i + r] = p.R[3 * r] * v_along[0] + p.R[3 * r + 1] * v_along[1] + p.R[3 * r + 2] * v_along[2];
                for (int k = 0; k < 3; ++k) v_R[3 * r + k] = v_world[r] * p.unit[k] + away[r] * v_along[k];
            }
            const float w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
            const float by_q[4] = {
                2 * (x * (v_R[7] - v_R[5]) + y * (v_R[2] - v_R[6]) + z * (v_R[3] - v_R[1])),
                2 * (w * (v_R[7] - v_R[5]) + y * (v_R[1] + v_R[3]) + z * (v_R[2] + v_R[6])) - 4 * x * (v_R[4] + v_R[8]),
                2 * (w * (v_R[2] - v_R[6]) + x * (v_R[1] + v_R[3]) + z * (v_R[5] + v_R[7])) - 4 * y * (v_R[0] + v_R[8]),
                2 * (w * (v_R[3] - v_R[1]) + x * (v_R[2] + v_R[6]) + y * (v_R[5] + v_R[7])) - 4 * z * (v_R[0] + v_R[4]),
            };
            float along_q = 0;
            for (int k = 0; k < 4; ++k) along_q += by_q[k] * p.q[k];
            for (int k = 0; k < 4; ++k) v_quats[4 * i + k] = (by_q[k] - along_q * p.q[k]) / p.length;
        }
    });
}

PlaneErrorSum plane_error(const PlaneError& a, int64_t n, int threads) {
    std::vector<PlaneErrorSum> sums(size_t((n + kChunk - 1) / kChunk));
    over_chunks(n, threads, [&](int64_t begin, int64_t end, int chunk) {
        PlaneErrorSum sum{0, 0};
        for (int64_t i = begin; i < end; ++i) {
            const float *f = a.features + 4 * i, *r = a.rays + 3 * i;
            const float slope = f[0] * r[0] + f[1] * r[1] + f[2] * r[2];
            const float steepest = (f[0] * f[0] + f[1] * f[1] + f[2] * f[2]) * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
            const bool met = a.counted[i] && slope > 0 && slope * slope > a.least * a.least * steepest;
            if (a.v_features) {
                float* v = a.v_features + 4 * i;
                const float depth = met ? f[3] / slope : 0, off = depth - a.target[i];
                const float by_depth = met ? std::copysign(a.scale / (1 + std::fabs(off)), off) / slope : 0;
                for (int k = 0; k < 3; ++k) v[k] = -by_depth * depth * r[k];
                v[3] = by_depth;
            } else if (met) {
                sum.error += std::log1p(std::fabs(f[3] / slope - a.target[i]));
                sum.pixels += 1;
            }
        }
        sums[chunk] = sum;
    });
    PlaneErrorSum total{0, 0};
    for (const PlaneErrorSum& s : sums) total.error += s.error, total.pixels += s.pixels;
    return total;
}

}  // namespace p2gs
