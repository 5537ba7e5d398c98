// How rigidly carried Gaussians pull at their parts: a loss's gradient by small motions of each part (p2gs/motion/part_pull.py).
#pragma once

#include <cstdint>

namespace p2gs {

// means, grad_means, seen_from [n, 3], quats, grad_quats [n, 4]; rows grouped by part, part k from starts[k] to starts[k + 1].
// centres [parts, 3] of the rotations.  Where seen_from is not null, rows whose direction to `eye` [3] has a cosine below `least` with
// seen_from turned by turns [parts, 3, 3] have no say.
struct PullArgs {
    const float *means, *quats, *grad_means, *grad_quats, *seen_from, *turns, *eye;
    const double* centres;
    const int64_t *rows, *starts;
    int parts;
    float least;
};

// out [parts, 6]: by rotation, by translation. One thread: it takes less than waking another.
void part_pulls(const PullArgs& args, double* out);

}  // namespace p2gs
