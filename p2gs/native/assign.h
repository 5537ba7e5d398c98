// Part assignment of Gaussians: probabilities softmax(W psi + b) of embeddings psi under a shared linear classifier, and the gradient.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kAssignChunk = 512;  // Gaussians
constexpr int kAssignDim = 64;     // at most, of an embedding
constexpr int kAssignParts = 32;   // at most

// psi [n, dim]; probabilities and their gradients lie part by part, n apart. weight [parts, dim] and bias [parts] make logits.
struct AssignArgs {
    int64_t n;
    int dim, parts;
    float sharpness;  // 1 / temperature: factor of the logits
    const float *psi, *weight, *bias;
    float* probs;  // written by forward, read by backward
    // backward: gradient by the probabilities; to psi; sums [chunk][parts][dim + 1] of those to the weights, the bias last
    const float* grad;
    float *v_psi, *sums;
};

struct AssignKernels {
    void (*forward)(const AssignArgs&, int chunk);
    void (*backward)(const AssignArgs&, int chunk);
};

// Same bits for any number of threads. args.sums is filled in here.
void assign_forward(const AssignArgs& args, int threads);
void assign_backward(AssignArgs args, float* v_weight, float* v_bias, int threads);

}  // namespace p2gs
