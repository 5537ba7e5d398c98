// The quaternion of a rotation.
#pragma once

#include <cmath>

namespace p2gs {

// Unit quaternion wxyz, w >= 0: of 4 q q^T, which R gives linearly, the row of the largest component.
inline void quaternion(const double R[3][3], double out[4]) {
    const double wx = R[2][1] - R[1][2], wy = R[0][2] - R[2][0], wz = R[1][0] - R[0][1];
    const double xy = R[0][1] + R[1][0], xz = R[0][2] + R[2][0], yz = R[1][2] + R[2][1];
    const double outer[4][4] = {{1 + R[0][0] + R[1][1] + R[2][2], wx, wy, wz},
                                {wx, 1 + R[0][0] - R[1][1] - R[2][2], xy, xz},
                                {wy, xy, 1 - R[0][0] + R[1][1] - R[2][2], yz},
                                {wz, xz, yz, 1 - R[0][0] - R[1][1] + R[2][2]}};
    int best = 0;
    double length = 0;
    for (int i = 1; i < 4; ++i)
        if (outer[i][i] > outer[best][best]) best = i;
    for (double v : outer[best]) length += v * v;
    length = std::sqrt(length) * (outer[best][0] < 0 ? -1 : 1);
    for (int i = 0; i < 4; ++i) out[i] = outer[best][i] / length;
}

}  // namespace p2gs
