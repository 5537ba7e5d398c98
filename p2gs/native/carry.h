// Gaussians carried by rigid motions, each by its part's: means, quaternions and spherical harmonics. No gradient.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kBands = 9 + 25 + 49;  // a square matrix for each band 1, 2, 3

// Rows of `rows`, which are grouped by part, are read and written; the others are not touched. bases: 1, 4, 9 or 16; with one the
// harmonics stay as they are and may be null.
struct CarryArgs {
    const float *means, *quats, *sh;
    float *out_means, *out_quats, *out_sh;
    const int64_t* rows;
    int bases;
};

// R t (three rows of 4), unit quaternion, the bands' matrices.
struct CarryMotion {
    float rigid[12], quat[4], bands[kBands];
};

struct CarryKernels {
    void (*rows)(const CarryArgs&, const CarryMotion&, int64_t begin, int64_t end);
};

// transforms [parts, 4, 4]; starts [parts + 1]: part k has rows[starts[k]] up to rows[starts[k + 1]]. tables, for each band l of the
// harmonics: 4 l + 8 directions and the inverse [2 l + 1, 4 l + 8] of the band's bases there. Same bits for any number of threads.
void carry(const CarryArgs& args, const float* transforms, const double* tables, const int64_t* starts, int parts, int threads);

}  // namespace p2gs
