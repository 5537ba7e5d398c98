// How much inverse depth bends where a photograph shows nothing: second differences along rows and columns, weighted by how little the
// photograph varies along them, with the gradient by the rendered depth. See p2gs/ops/planar.py.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kPlanarRows = 16;  // of a chunk

// Planes of the workspace have rows of `pitch` floats, `pad` of them before the first pixel. What a step between two pixels travels is kept
// in fixed point, `unit` to one contrast: running sums may then wrap around, and their differences are exact.
struct PlanarArgs {
    int64_t height, width, pitch, pad;
    const float *image, *target_alpha, *depth, *alpha;  // photograph [h, w, 3] and [h, w]; rendered [h, w], accumulated
    const int* strides;
    int count;
    float contrast, noise, unit;
    // workspace: inverse depth, what was travelled along rows and along columns, and by direction and stride the weighted sign of each bend
    float *inverse, *bends;
    uint32_t* travelled[2];
    double* sums;             // [chunk][2 count][2]: weights, weighted bends
    const float* factors;     // [2 count], for the gradient
    float *v_depth, *v_alpha;
};

struct PlanarKernels {
    void (*prepare)(const PlanarArgs&, int64_t begin, int64_t end);  // rows
    void (*travel)(const PlanarArgs&, int64_t begin, int64_t end);   // columns
    void (*bend)(const PlanarArgs&, int64_t begin, int64_t end, double* sums);
    void (*gradient)(const PlanarArgs&, int64_t begin, int64_t end);
};

// Floats of a workspace.
int64_t planar_workspace(int64_t height, int64_t width, const int* strides, int count);

// The mean over directions and strides of the weighted mean bend; gradients go to v_depth and v_alpha where they are not null.
// Strides that do not fit into a direction do not count there; at least one must. Same bits for any number of threads.
double planar(PlanarArgs args, float* workspace, int threads);

}  // namespace p2gs
