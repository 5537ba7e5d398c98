#pragma once

#include <cstdint>

namespace p2gs {

// One tensor of an Adam step. step_size = lr / (1 - beta1^t); bias2_sqrt = sqrt(1 - beta2^t). The differences from one are
// taken in double precision: 1 - 0.999f is wrong in the fifth digit.
struct AdamTensor {
    float* param;
    const float* grad;
    float* exp_avg;
    float* exp_avg_sq;
    int64_t size;
    float step_size, one_minus_beta1, beta2, one_minus_beta2, eps, bias2_sqrt;
};

struct AdamKernels {
    // Elements [begin, end) of one tensor.
    void (*step)(const AdamTensor& t, int64_t begin, int64_t end);
};

// All tensors in one go, shared out among threads. Same bits for any number of threads.
void adam_step(const AdamTensor* tensors, int count, int threads);

}  // namespace p2gs
