#include "steps.h"

#include <algorithm>
#include <cmath>

#include "quaternion.h"

namespace p2gs {
namespace {

struct Vec {
    double x[3];
    double operator[](int i) const { return x[i]; }
    double& operator[](int i) { return x[i]; }
};

Vec operator+(const Vec& a, const Vec& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
Vec operator-(const Vec& a, const Vec& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
Vec operator*(double s, const Vec& a) { return {s * a[0], s * a[1], s * a[2]}; }
double dot(const Vec& a, const Vec& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
Vec cross(const Vec& a, const Vec& b) { return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}; }

struct Step {
    Vec turn, shift;
};

// The rotation vector of T's rotation, of length in 0..pi.
Vec rotation_vector(const double* T) {
    const double R[3][3] = {{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}};
    double q[4];
    quaternion(R, q);
    const Vec v = {q[1], q[2], q[3]};
    const double s = std::sqrt(dot(v, v));
    return (s > 1e-12 ? 2 * std::atan2(s, q[0]) / s : 2 / q[0]) * v;
}

// Rodrigues.
void rotation(const Vec& w, double R[3][3]) {
    const double square = dot(w, w), angle = std::sqrt(square), half = angle / 2;
    const double a = angle > 1e-6 ? std::sin(angle) / angle : 1 - square / 6;
    const double h = half > 1e-6 ? std::sin(half) / half : 1 - square / 24, b = h * h / 2;
    const double W[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) R[i][j] = (i == j) + a * W[i][j] + b * (w[i] * w[j] - (i == j) * square);
}

// Adam's direction times -rate.
Step proposed(const StepArgs& a, int k) {
    double *m = a.first + 6 * k, *v = a.second + 6 * k, step[6];
    for (int i = 0; i < 6; ++i) {
        const double g = a.gradient[6 * k + i] / (i < 3 ? a.radius[k] : 1.0);
        if (a.on[k]) m[i] = 0.9 * m[i] + 0.1 * g, v[i] = 0.99 * v[i] + 0.01 * g * g;
        step[i] = -a.rate * (m[i] / a.fades[k] / (std::sqrt(v[i] / a.fades[a.parts + k]) + 1e-12));
    }
    return {{step[0], step[1], step[2]}, {step[3], step[4], step[5]}};
}

// The step without what would give a turn a pitch, with a Newton correction for what pitch there is.
Step without_pitch(const double* T, const Vec& centre, double radius, const Step& step) {
    const Vec w = rotation_vector(T), t = {T[3], T[7], T[11]};
    const double angle = std::max(std::sqrt(dot(w, w)), 1e-3);
    const Vec axis = (1 / angle) * w;
    const double pitch = dot(axis, t);
    const Vec across = t - pitch * axis;
    const Vec tilt = (1 / (2 * std::tan(angle / 2))) * across + 0.5 * cross(axis, across);
    const Vec normal = (1 / radius) * (cross(t - centre, axis) + tilt);
    const double square = std::max(dot(normal, normal) + dot(axis, axis), 1e-12);
    const double off = (dot(normal, step.turn) + dot(axis, step.shift) + pitch) / square;
    return {step.turn - off * normal, step.shift - off * axis};
}

}  // namespace

void motion_steps(const StepArgs& a, double* out) {
    for (int k = 0; k < a.parts; ++k) {
        const double *T = a.transforms + 16 * k, *c = a.centre + 3 * k, radius = a.radius[k];
        const JointKind kind = JointKind(a.kinds[k]);
        const Vec centre = {c[0], c[1], c[2]};
        double* to = out + 16 * k;
        std::copy(T, T + 16, to);
        Step step = proposed(a, k);
        if (kind == JointKind::turn) step = without_pitch(T, centre, radius, step);
        if (kind == JointKind::slide) step.turn = {0, 0, 0};
        if (a.axes && !std::isnan(a.axes[3 * k] + a.axes[3 * k + 1] + a.axes[3 * k + 2])) {
            const Vec d = {a.axes[3 * k], a.axes[3 * k + 1], a.axes[3 * k + 2]}, along = dot(step.shift, d) * d;
            step = {dot(step.turn, d) * d, kind == JointKind::slide ? along : step.shift - along};
        }
        if (a.on[k]) {
            double R[3][3];
            rotation((1 / radius) * step.turn, R);
            for (int i = 0; i < 3; ++i) {
                const Vec row = {R[i][0], R[i][1], R[i][2]};
                for (int j = 0; j < 4; ++j) to[4 * i + j] = row[0] * T[j] + row[1] * T[4 + j] + row[2] * T[8 + j];
                to[4 * i + 3] += centre[i] - dot(row, centre) + step.shift[i];
            }
        }
        if (kind == JointKind::slide)
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) to[4 * i + j] = i == j;
    }
}

}  // namespace p2gs
