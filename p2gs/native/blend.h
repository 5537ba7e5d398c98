// Gaussians moved by softly assigned rigid motions: mean' = sum_k p_k (R_k mean + t_k), and the turn is the p-weighted mean of the parts'
// unit quaternions. A motion is the exponential of a twist (rotation vector, linear part); slot 0 stands still.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kBlendChunk = 256;  // Gaussians
constexpr int kMotion = 16;       // R t (three rows of 4), unit quaternion

// parts x kMotion floats in `motions`; probabilities and their gradients lie part by part, n apart.
struct BlendArgs {
    int64_t n;
    int parts;
    const float *means, *quats, *probs, *motions;
    // forward
    float *out_means, *out_quats;
    // backward: gradients by the outputs (each may be null) and to the inputs; sums [chunk][parts][kMotion] of those to the motions
    const float *grad_means, *grad_quats;
    float *v_means, *v_quats, *v_probs, *sums;
};

struct BlendKernels {
    void (*forward)(const BlendArgs&, int chunk);
    void (*backward)(const BlendArgs&, int chunk);
};

// twists [parts - 1, 6]; args.motions and args.sums are filled in here. Same bits for any number of threads.
void blend_forward(BlendArgs args, const float* twists, int threads);
void blend_backward(BlendArgs args, const float* twists, float* v_twists, int threads);

// The motions themselves: [parts, 4, 4], slot 0 the identity, and the gradient from there (the last rows' is not read).
void part_motions(int parts, const float* twists, float* out);
void part_motions_backward(int parts, const float* twists, const float* grad, float* v_twists);

}  // namespace p2gs
