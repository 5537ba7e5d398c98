#pragma once

#include <cstdint>

namespace p2gs {

// Images are H rows of n = 3 W interleaved floats, `*_stride` floats apart. Statistics are planes of H rows of `padded` floats.
struct SsimArgs {
    const float* pred;
    const float* target;
    float* grad;  // null: value only
    int64_t pred_stride, target_stride, grad_stride;
    int rows, n, padded;
    const float* zeros;              // a row of `padded` zeros
    float *target_mean, *target_sq;  // window means of y and of y^2
    float l1_weight, ssim_weight;    // derivative of the loss by one element of |x - y| and of SSIM
};

// Scratch of a kernel call, zero to begin with: 15 rows of `padded` + 2 kSsimMargin floats and 3 kSsimRing rows of `padded`.
constexpr int kSsimMargin = 32;
constexpr int kSsimRing = 17;  // a group of four reads 14 rows, and the forward rows are up to three ahead of it

struct SsimKernels {
    // Fills target_mean and target_sq for rows [y0, y1).
    void (*target)(const SsimArgs&, int y0, int y1, float* scratch);
    // Rows [y0, y1): the gradient, and (sum of SSIM, sum of |x - y|) of each row. No bit depends on how rows are shared out.
    void (*loss)(const SsimArgs&, int y0, int y1, float* scratch, double* sums);
};

// Row length of the statistics for rows of n floats.
int ssim_padded(int n);

// (1 - lam) mean|x - y| + lam (1 - mean SSIM(x, y)); fills args.grad with its gradient by x where that is given.
// `have_target`: target_mean and target_sq are filled already. Same bits for any number of threads.
double l1_ssim(SsimArgs args, float lam, bool have_target, int threads);

}  // namespace p2gs
