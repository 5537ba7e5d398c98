// Motions of one degree of freedom in bulk: their matrices, and steps in their own coordinates. A few flops each, in double.
#pragma once

#include <cstdint>
#include <vector>

namespace p2gs {

// Motions start -> end: turn [B], axis [B, 3], centre [B, 3], amount [B].
struct MotionBatch {
    const uint8_t* turn;
    const float *axis, *centre, *amount;
    int64_t count;
};

// R [B, 3, 3] and t [B, 3] of the motions.
void motion_matrices(const MotionBatch& motions, float* R, float* t);

// The motions after steps [B, 5]: axis [B, 3], centre [B, 3], amount [B].
void motion_displaced(const MotionBatch& motions, const float* step, float* axis, float* centre, float* amount);

// Root mean square distance [B, C] between the images of points [size, 3] under motions a and b.
void motion_swept(const MotionBatch& a, const MotionBatch& b, const float* points, int64_t size, float* out);

// Rows of rotation and translation [B][12] of the motions or, back, their inverses.
std::vector<float> motion_rows(const MotionBatch& motions, bool back);

}  // namespace p2gs
