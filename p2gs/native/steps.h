// Adam's steps on rigid motions of joints of given types (p2gs/motion/motion_steps.py).
#pragma once

#include <cstdint>

namespace p2gs {

enum class JointKind : uint8_t { free = 0, turn = 1, slide = 2 };

// transforms [parts, 4, 4], gradient [parts, 6] by rotation about centre [parts, 3] and by translation, radius [parts], kinds and on [parts].
// axes [parts, 3]: directions that joints keep (NaN: free), or null.  first, second [parts, 6]: Adam's moments, which change; fades [2, parts]:
// what each is divided by, as it started at 0.
struct StepArgs {
    const double *transforms, *gradient, *centre, *radius, *axes, *fades;
    const uint8_t *kinds, *on;
    double *first, *second;
    int parts;
    double rate;
};

// out [parts, 4, 4]: the motions after the step. One thread: it takes less than waking another.
void motion_steps(const StepArgs& args, double* out);

}  // namespace p2gs
