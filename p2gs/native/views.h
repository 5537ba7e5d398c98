// Depth maps asked about points: how many views see past a point, see it on a surface, have something in front of it.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kView = 18;  // floats of a view: rows of [R | t], fx, fy, cx, cy, width, height

struct DepthViews {
    const float *near, *far;  // [view][height][width]
    const float* cameras;     // [view][kView]
    int32_t height, width;
    const int64_t* views;  // those asked
    int64_t count;
    float tau;
};

struct ViewKernels {
    // Points [begin, end) of `points` [size, 3]: out [3][size] counts of free, on a surface, behind.
    void (*counts)(const DepthViews&, const float* points, int64_t size, int64_t begin, int64_t end, float* out);
    // out [3][size] sums of the unit directions to the cameras that see each point on a surface.
    void (*directions)(const DepthViews&, const float* points, int64_t size, int64_t begin, int64_t end, float* out);
};

// The same bits for any number of threads.
void depth_counts(const DepthViews& views, const float* points, int64_t size, float* out, int threads);
void depth_directions(const DepthViews& views, const float* points, int64_t size, float* out, int threads);

}  // namespace p2gs
