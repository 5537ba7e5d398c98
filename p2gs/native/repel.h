// The local force of repel points: for each point the pull of those within a radius, and how it changes with the point.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int64_t kRepelChunk = 64;  // points

// Sources are sorted along x, in planes (x, y, z) of `padded` floats, infinite behind the last. With o = source - point and
// a = max(|o|, eps)^-exponent: pull = mean (or sum) of a o, slope = the same of d (a o) / d point as xx, yy, zz, xy, xz, yz.
struct RepelArgs {
    const float* points;   // [n, 3]
    const float* sources;  // planes
    int64_t n, padded;
    float radius, eps, exponent;
    bool mean;  // over the sources in reach; else their sum
    float *pull, *slope;  // [n, 3], [n, 6]
};

struct RepelKernels {
    void (*local)(const RepelArgs&, int64_t begin, int64_t end);
};

// sources [count, 3] as they come. All coordinates finite. Same bits for any number of threads.
void repel_local(RepelArgs args, const float* sources, int64_t count, int threads);

}  // namespace p2gs
