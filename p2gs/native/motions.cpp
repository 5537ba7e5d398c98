#include "motions.h"

#include <algorithm>
#include <cmath>

namespace p2gs {
namespace {

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

void cross(const double* a, const double* b, double* out) {
    for (int i = 0; i < 3; ++i) out[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

void normalize(double* a, double least = 1e-12) {
    const double length = std::max(std::sqrt(dot(a, a)), least);
    for (int i = 0; i < 3; ++i) a[i] /= length;
}

// Rodrigues.
void rotation(const double* a, double angle, double R[3][3]) {
    const double s = std::sin(angle), c = std::cos(angle), square = dot(a, a);
    const double K[3][3] = {{0, -a[2], a[1]}, {a[2], 0, -a[0]}, {-a[1], a[0], 0}};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) R[i][j] = (i == j) + s * K[i][j] + (1 - c) * (a[i] * a[j] - (i == j) * square);
}

struct Rigid {
    double R[3][3], t[3];
};

Rigid matrix(const MotionBatch& m, int64_t b) {
    Rigid out;
    const double axis[3] = {m.axis[3 * b], m.axis[3 * b + 1], m.axis[3 * b + 2]};
    const double centre[3] = {m.centre[3 * b], m.centre[3 * b + 1], m.centre[3 * b + 2]};
    rotation(axis, m.turn[b] ? m.amount[b] : 0.0, out.R);
    for (int i = 0; i < 3; ++i) out.t[i] = m.turn[b] ? centre[i] - dot(out.R[i], centre) : axis[i] * m.amount[b];
    return out;
}

}  // namespace

void motion_matrices(const MotionBatch& motions, float* R, float* t) {
    for (int64_t b = 0; b < motions.count; ++b) {
        const Rigid m = matrix(motions, b);
        for (int i = 0; i < 9; ++i) R[9 * b + i] = float(m.R[i / 3][i % 3]);
        for (int i = 0; i < 3; ++i) t[3 * b + i] = float(m.t[i]);
    }
}

std::vector<float> motion_rows(const MotionBatch& motions, bool back) {
    std::vector<float> out(size_t(motions.count) * 12);
    for (int64_t b = 0; b < motions.count; ++b) {
        const Rigid m = matrix(motions, b);
        for (int i = 0; i < 3; ++i) {
            float* row = out.data() + 12 * b + 4 * i;
            for (int j = 0; j < 3; ++j) row[j] = float(back ? m.R[j][i] : m.R[i][j]);
            row[3] = float(back ? -(m.R[0][i] * m.t[0] + m.R[1][i] * m.t[1] + m.R[2][i] * m.t[2]) : m.t[i]);
        }
    }
    return out;
}

void motion_swept(const MotionBatch& a, const MotionBatch& b, const float* points, int64_t size, float* out) {
    // mean |D p + d|^2 = tr(D M D^T) + 2 d . D m + d . d, with the points' moments m and M: no pair looks at points
    double mean[3] = {}, square[3][3] = {};
    for (int64_t p = 0; p < size; ++p)
        for (int i = 0; i < 3; ++i) {
            mean[i] += double(points[3 * p + i]) / size;
            for (int j = 0; j < 3; ++j) square[i][j] += double(points[3 * p + i]) * points[3 * p + j] / size;
        }
    std::vector<Rigid> others(b.count);
    for (int64_t k = 0; k < b.count; ++k) others[k] = matrix(b, k);
    for (int64_t i = 0; i < a.count; ++i) {
        const Rigid one = matrix(a, i);
        for (int64_t k = 0; k < b.count; ++k) {
            double total = 0;
            for (int r = 0; r < 3; ++r) {
                double D[3], MD[3];
                const double d = one.t[r] - others[k].t[r];
                for (int c = 0; c < 3; ++c) D[c] = one.R[r][c] - others[k].R[r][c];
                for (int c = 0; c < 3; ++c) MD[c] = dot(square[c], D);
                total += dot(D, MD) + 2 * d * dot(D, mean) + d * d;
            }
            out[i * b.count + k] = float(std::sqrt(std::max(total, 0.0)));
        }
    }
}

void motion_displaced(const MotionBatch& motions, const float* step, float* axis_out, float* centre_out, float* amount_out) {
    for (int64_t b = 0; b < motions.count; ++b) {
        const float *a = motions.axis + 3 * b, *s = step + 5 * b;
        const double axis[3] = {a[0], a[1], a[2]};
        int least = 0;
        for (int i = 1; i < 3; ++i)
            if (std::fabs(a[i]) < std::fabs(a[least])) least = i;
        double helper[3] = {}, e1[3], e2[3], tilt[3], unit[3], next[3], amount = double(motions.amount[b]) + s[0];
        helper[least] = 1;
        cross(helper, axis, e1);
        normalize(e1);
        cross(axis, e1, e2);
        for (int i = 0; i < 3; ++i) unit[i] = tilt[i] = s[1] * e1[i] + s[2] * e2[i];
        if (motions.turn[b]) {
            double R[3][3];
            normalize(unit);
            rotation(unit, std::sqrt(dot(tilt, tilt)), R);
            for (int i = 0; i < 3; ++i) next[i] = dot(R[i], axis);
            normalize(next);
        } else {
            for (int i = 0; i < 3; ++i) next[i] = axis[i] * amount + tilt[i];
            const double length = std::sqrt(dot(next, next)), sign = dot(next, axis) < 0 ? -1.0 : 1.0;
            for (int i = 0; i < 3; ++i) next[i] = length > 1e-9 ? next[i] / length * sign : axis[i];
            amount = length * sign;
        }
        for (int i = 0; i < 3; ++i) {
            axis_out[3 * b + i] = float(next[i]);
            centre_out[3 * b + i] = float(motions.centre[3 * b + i] + (motions.turn[b] ? s[3] * e1[i] + s[4] * e2[i] : 0.0));
        }
        amount_out[b] = float(amount);
    }
}

}  // namespace p2gs
