#include "pull.h"

#include <algorithm>
#include <cmath>

namespace p2gs {
namespace {

bool faces(const PullArgs& a, int part, int64_t row) {
    const float *R = a.turns + 9 * part, *s = a.seen_from + 3 * row, *x = a.means + 3 * row;
    const float way[3] = {a.eye[0] - x[0], a.eye[1] - x[1], a.eye[2] - x[2]};
    const float length = std::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    float cosine = 0;
    for (int i = 0; i < 3; ++i) cosine += (R[3 * i] * s[0] + R[3 * i + 1] * s[1] + R[3 * i + 2] * s[2]) * way[i];
    return cosine / std::max(length, 1e-12f) >= a.least;
}

}  // namespace

void part_pulls(const PullArgs& a, double* out) {
    for (int k = 0; k < a.parts; ++k) {
        double sums[6] = {};
        const double* centre = a.centres + 3 * k;
        for (int64_t i = a.starts[k]; i < a.starts[k + 1]; ++i) {
            const int64_t row = a.rows[i];
            if (a.seen_from && !faces(a, k, row)) continue;
            const float *x = a.means + 3 * row, *q = a.quats + 4 * row, *g = a.grad_means + 3 * row, *h = a.grad_quats + 4 * row;
            const double arm[3] = {x[0] - centre[0], x[1] - centre[1], x[2] - centre[2]};
            for (int c = 0; c < 3; ++c) {
                const int d = (c + 1) % 3, e = (c + 2) % 3;
                // a rotation by w turns the quaternion q into q + 0.5 (0, w) q
                const double turn = double(q[0]) * h[c + 1] - double(h[0]) * q[c + 1] + double(q[d + 1]) * h[e + 1] - double(q[e + 1]) * h[d + 1];
                sums[c] += arm[d] * g[e] - arm[e] * g[d] + 0.5 * turn;
                sums[3 + c] += g[c];
            }
        }
        std::copy(sums, sums + 6, out + 6 * k);
    }
}

}  // namespace p2gs
