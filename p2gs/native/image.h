// What a training step does with whole images beside rendering them and SSIM: one pass each, instead of a dozen in torch.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int64_t kPixels = 1 << 13;  // of a chunk

struct CrossEntropy {
    const float *pred, *target;
    float* grad;  // null: the value, else the gradient
    float low, high, scale;  // pred is clamped to [low, high]; gradient of the sum times `scale`
};

// sum over pixels with target above one half of v / (1 + v / knee^2), v = alpha depth_sq - (depth - ref alpha)^2, and
// its gradients times `scale`.
struct DepthSpread {
    const float *alpha, *depth, *depth_sq, *target;
    float *v_alpha, *v_depth, *v_depth_sq;  // all null: the value, else the gradients
    float ref, scale;
    float per_knee;  // 1 / knee^2; 0: v itself
};

// Premultiplied bytes over a background: image [n, 3], alpha [n].
struct Compose {
    const uint8_t *colour, *alpha8;
    float *image, *alpha;
    float background[3];
};

struct ImageKernels {
    // Pixels [begin, end); the sum over them.
    double (*cross_entropy)(const CrossEntropy&, int64_t begin, int64_t end);
    double (*depth_spread)(const DepthSpread&, int64_t begin, int64_t end);
    void (*compose)(const Compose&, int64_t begin, int64_t end);
};

// Sums over n pixels. Same bits for any number of threads.
double cross_entropy(const CrossEntropy& args, int64_t n, int threads);
double depth_spread(const DepthSpread& args, int64_t n, int threads);
void compose(const Compose& args, int64_t n, int threads);
// Elements above one half.
int64_t count_inside(const float* target, int64_t n);

}  // namespace p2gs
