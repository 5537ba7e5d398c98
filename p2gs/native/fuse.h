// Depth maps averaged into a truncated signed distance field (see p2gs/surface/integrate.py).
#pragma once

#include <cstdint>

namespace p2gs {

// Pixels lie row by row. depth, label, dot and cosine [height, width], colour [height, width, 3]; to_pixel: rows of the matrix that takes
// points to pixels times depth.
struct FuseView {
    const float *depth, *dot, *cosine;
    const uint8_t* colour;
    const int16_t* label;
    float to_pixel[12];
    int32_t width, height;
};

struct FuseArgs {
    const FuseView* views;
    int64_t count, part;
    float trunc, behind, free_weight;
    const float* points;  // [n, 3]
    // signed distance [n], weight of surface sightings [n], colour [n, 3], weight of all that went into the distance [n]
    float *field, *seen, *colour, *weight;
};

struct FuseKernels {
    void (*points)(const FuseArgs&, int64_t begin, int64_t end);
};

// The same bits for any number of threads.
void fuse_views(const FuseArgs& args, int64_t n, int threads);

}  // namespace p2gs
