// How well all photographs agree along rays (p2gs/ops/sweep.py).
#pragma once

#include <cstdint>

namespace p2gs {

// pictures [views, height, width, 4], of which the first sizes [views, 2] (width, height) pixels are a view's; lines [views, 3, 4]:
// world -> pixel, times depth; rays: origins and ways [n, 3], colours [n, 4]; depths [steps]: points are origin + depth * way.
// tolerance: of the sum over the four channels, at which a view does not agree at all.
struct Sweep {
    const float *pictures, *sizes, *lines, *origins, *ways, *colours, *depths;
    int64_t views, height, width, steps;
    float tolerance;
};

struct SweepKernels {
    // Rays [begin, end): agreement summed over the views, added to sum [n, steps].
    void (*look)(const Sweep&, int64_t begin, int64_t end, float* sum);
};

// out [n, steps]: how well the views agree with the ray's colour at each step, 0 to 1 in the mean, those that do not contain the point
// counting as 0. The same bits for any number of threads.
void sweep(const Sweep& args, int64_t n, float* out, int threads);

}  // namespace p2gs
