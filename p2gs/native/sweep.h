// Depth along rays by how well all photographs agree there (p2gs/ops/sweep.py).
#pragma once

#include <cstdint>

namespace p2gs {

// pictures [views, height, width, 4], of which the first sizes [views, 2] (width, height) pixels are a view's; lines [views, 3, 4]: world -> pixel, times depth; rays: origins and ways [n, 3], colours [n, 4];
// depths [steps]: points are origin + depth * way. tolerance: of the sum over the four channels, beyond which a view disagrees fully.
struct Sweep {
    const float *pictures, *sizes, *lines, *origins, *ways, *colours, *depths;
    int64_t views, height, width, steps;
    float tolerance;
};

// best [n]: the step with the least mean disagreement (0 to 1) of the views that a point is in, the first of equal ones; cost [n]: that
// mean, 1 where no view sees any of the points.
void sweep(const Sweep& args, int64_t n, int64_t* best, float* cost, int threads);

}  // namespace p2gs
