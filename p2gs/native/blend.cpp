#include "blend.h"

#include <cmath>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

// f(x) and f'(x) of x = theta^2.
struct Smooth {
    double value, slope;
};

// sum c_i x^i
template <int n>
Smooth series(const double (&c)[n], double x) {
    Smooth o = {0, 0};
    for (int i = n - 1; i >= 0; --i) {
        o.slope = o.slope * x + o.value;
        o.value = o.value * x + c[i];
    }
    return o;
}

// The functions of a rotation by theta: R = I + sinc W + versinc W^2, V = I + versinc W + third W^2, quaternion (cosine, half w).
struct Turning {
    Smooth sinc, versinc, third, half, cosine;
};

Turning turning(double x) {
    Turning o;
    if (x < 0.25) {  // closed forms lose digits here; the first term left out is below 1e-17
        o.sinc = series({1, -1. / 6, 1. / 120, -1. / 5040, 1. / 362880, -1. / 39916800, 1. / 6227020800.}, x);
        o.versinc = series({1. / 2, -1. / 24, 1. / 720, -1. / 40320, 1. / 3628800, -1. / 479001600, 1. / 87178291200.}, x);
        o.third = series({1. / 6, -1. / 120, 1. / 5040, -1. / 362880, 1. / 39916800, -1. / 6227020800., 1. / 1307674368000.}, x);
    } else {
        const double t = std::sqrt(x), s = std::sin(t), c = std::cos(t);
        o.sinc = {s / t, (t * c - s) / (2 * t * x)};
        o.versinc = {(1 - c) / x, (t * s - 2 * (1 - c)) / (2 * x * x)};
        o.third = {(t - s) / (t * x), (3 * s - t * c - 2 * t) / (2 * x * x * t)};
    }
    const double y = x / 4;
    Smooth h = series({1, -1. / 6, 1. / 120, -1. / 5040, 1. / 362880, -1. / 39916800, 1. / 6227020800.}, y);
    if (y >= 0.25) {
        const double t = std::sqrt(y), s = std::sin(t), c = std::cos(t);
        h = {s / t, (t * c - s) / (2 * t * y)};
    }
    o.half = {h.value / 2, h.slope / 8};
    o.cosine = {std::cos(std::sqrt(y)), -h.value / 8};
    return o;
}

void multiply(const double* a, const double* b, double* o) {
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) o[3 * r + c] = a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c];
}

struct Motion {
    double w[3], v[3], W[9], WW[9];
    Turning f;
    double sign;  // of the quaternion, so that its w >= 0: nearest to slot 0

    explicit Motion(const float* twist) {
        for (int i = 0; i < 3; ++i) w[i] = twist[i], v[i] = twist[3 + i];
        const double skew[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0};
        for (int i = 0; i < 9; ++i) W[i] = skew[i];
        multiply(W, W, WW);
        f = turning(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
        sign = f.cosine.value < 0 ? -1 : 1;
    }

    void write(float* out) const {
        for (int r = 0; r < 3; ++r) {
            double t = v[r];
            for (int c = 0; c < 3; ++c) {
                out[4 * r + c] = float((r == c) + f.sinc.value * W[3 * r + c] + f.versinc.value * WW[3 * r + c]);
                t += (f.versinc.value * W[3 * r + c] + f.third.value * WW[3 * r + c]) * v[c];
            }
            out[4 * r + 3] = float(t);
            out[13 + r] = float(sign * f.half.value * w[r]);
        }
        out[12] = float(sign * f.cosine.value);
    }

    // g [kMotion]: gradient by what write() gives.
    void gradient(const double* g, float* out) const {
        double GR[9], GV[9], v_W[9];
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) {
                GR[3 * r + c] = g[4 * r + c];
                GV[3 * r + c] = g[4 * r + 3] * v[c];
            }
        // by W: a G + b (G W^T + W^T G) for each of R (sinc, versinc) and V (versinc, third); W^T = -W
        double both[9], left[9], right[9], by_sinc = 0, by_versinc = 0, by_third = 0;
        for (int i = 0; i < 9; ++i) {
            both[i] = f.versinc.value * GR[i] + f.third.value * GV[i];
            by_sinc += GR[i] * W[i];
            by_versinc += GR[i] * WW[i] + GV[i] * W[i];
            by_third += GV[i] * WW[i];
        }
        multiply(both, W, left);
        multiply(W, both, right);
        for (int i = 0; i < 9; ++i) v_W[i] = f.sinc.value * GR[i] + f.versinc.value * GV[i] - left[i] - right[i];
        const double v_w[3] = {v_W[7] - v_W[5], v_W[2] - v_W[6], v_W[3] - v_W[1]};
        const double along = sign * (g[13] * w[0] + g[14] * w[1] + g[15] * w[2]);
        const double by_x = by_sinc * f.sinc.slope + by_versinc * f.versinc.slope + by_third * f.third.slope + along * f.half.slope +
                            sign * g[12] * f.cosine.slope;
        for (int c = 0; c < 3; ++c) {
            out[c] = float(v_w[c] + sign * f.half.value * g[13 + c] + 2 * by_x * w[c]);
            double sum = g[4 * c + 3];
            for (int r = 0; r < 3; ++r) sum += (f.versinc.value * W[3 * r + c] + f.third.value * WW[3 * r + c]) * g[4 * r + 3];
            out[3 + c] = float(sum);
        }
    }
};

std::vector<float> motions_of(int parts, const float* twists) {
    std::vector<float> motions(size_t(parts) * kMotion);
    for (int i : {0, 5, 10, 12}) motions[i] = 1;
    for (int k = 1; k < parts; ++k) Motion(twists + 6 * (k - 1)).write(motions.data() + k * kMotion);
    return motions;
}

int chunks_of(const BlendArgs& args) { return int((args.n + kBlendChunk - 1) / kBlendChunk); }

}  // namespace

void blend_forward(BlendArgs args, const float* twists, int threads) {
    const std::vector<float> motions = motions_of(args.parts, twists);
    args.motions = motions.data();
    parallel_for(chunks_of(args), threads, [](int chunk, int, void* p) { kernels().blend.forward(*static_cast<BlendArgs*>(p), chunk); }, &args);
}

void blend_backward(BlendArgs args, const float* twists, float* v_twists, int threads) {
    const std::vector<float> motions = motions_of(args.parts, twists);
    std::vector<float> sums(size_t(chunks_of(args)) * args.parts * kMotion);
    args.motions = motions.data();
    args.sums = sums.data();
    parallel_for(chunks_of(args), threads, [](int chunk, int, void* p) { kernels().blend.backward(*static_cast<BlendArgs*>(p), chunk); }, &args);
    for (int k = 1; k < args.parts; ++k) {
        double total[kMotion] = {};
        for (int c = 0; c < chunks_of(args); ++c)
            for (int j = 0; j < kMotion; ++j) total[j] += sums[(size_t(c) * args.parts + k) * kMotion + j];
        Motion(twists + 6 * (k - 1)).gradient(total, v_twists + 6 * (k - 1));
    }
}

void part_motions(int parts, const float* twists, float* out) {
    const std::vector<float> motions = motions_of(parts, twists);
    for (int k = 0; k < parts; ++k) {
        for (int i = 0; i < 12; ++i) out[16 * k + i] = motions[k * kMotion + i];
        for (int i = 12; i < 16; ++i) out[16 * k + i] = i == 15;
    }
}

void part_motions_backward(int parts, const float* twists, const float* grad, float* v_twists) {
    for (int k = 1; k < parts; ++k) {
        double g[kMotion] = {};
        for (int i = 0; i < 12; ++i) g[i] = grad[16 * k + i];
        Motion(twists + 6 * (k - 1)).gradient(g, v_twists + 6 * (k - 1));
    }
}

}  // namespace p2gs
