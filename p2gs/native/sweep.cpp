#include "sweep.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "pool.h"

namespace p2gs {
namespace {

constexpr int64_t kRays = 32;  // neighbours look at the same lines of a picture, which so stay in the cache

// Sum over the channels of |bilinear pixel at (x, y) - colour|; x, y in pixels, inside the picture, whose rim is repeated.
inline float difference(const float* picture, int64_t stride, int64_t width, int64_t height, float x, float y, const float* colour) {
    const float u = x - 0.5f, v = y - 0.5f;
    const int64_t left = int64_t(u + 1) - 1, top = int64_t(v + 1) - 1;  // floor, u and v being at least -1/2
    const float a = u - float(left), b = v - float(top);
    const int64_t x0 = std::max<int64_t>(left, 0), x1 = std::min(left + 1, width - 1);
    const int64_t y0 = std::max<int64_t>(top, 0), y1 = std::min(top + 1, height - 1);
    const float *p = picture + 4 * (y0 * stride + x0), *q = picture + 4 * (y0 * stride + x1);
    const float *r = picture + 4 * (y1 * stride + x0), *s = picture + 4 * (y1 * stride + x1);
    float off[4];
    for (int c = 0; c < 4; ++c) {
        const float upper = p[c] + a * (q[c] - p[c]), lower = r[c] + a * (s[c] - r[c]);
        off[c] = std::fabs(upper + b * (lower - upper) - colour[c]);
    }
    return (off[0] + off[1]) + (off[2] + off[3]);
}

// One view's disagreement with a ray at all depths, added to sum and count [steps].
void look(const Sweep& a, int64_t view, int64_t ray, float* sum, float* count) {
    const float *picture = a.pictures + 4 * view * a.height * a.width, *line = a.lines + 12 * view;
    float at[3], step[3];
    for (int k = 0; k < 3; ++k) {
        const float *row = line + 4 * k, *o = a.origins + 3 * ray, *w = a.ways + 3 * ray;
        at[k] = row[0] * o[0] + row[1] * o[1] + row[2] * o[2] + row[3];
        step[k] = row[0] * w[0] + row[1] * w[1] + row[2] * w[2];
    }
    const float width = a.sizes[2 * view], height = a.sizes[2 * view + 1];
    for (int64_t d = 0; d < a.steps; ++d) {
        const float z = at[2] + a.depths[d] * step[2];
        const float x = (at[0] + a.depths[d] * step[0]) / z, y = (at[1] + a.depths[d] * step[1]) / z;
        if (!(z > 0 && x >= 0 && x < width && y >= 0 && y < height)) continue;
        sum[d] += std::min(difference(picture, a.width, int64_t(width), int64_t(height), x, y, a.colours + 4 * ray) / a.tolerance, 1.0f);
        count[d] += 1;
    }
}

}  // namespace

void sweep(const Sweep& args, int64_t n, int64_t* best, float* cost, int threads) {
    struct Context {
        const Sweep& a;
        int64_t n, *best;
        float* cost;
    } c{args, n, best, cost};
    parallel_for(int((n + kRays - 1) / kRays), threads, [](int chunk, int, void* p) {
        const Context& c = *static_cast<Context*>(p);
        const Sweep& a = c.a;
        const int64_t begin = chunk * kRays, end = std::min(begin + kRays, c.n);
        std::vector<float> sum(std::size_t(kRays * a.steps)), count(std::size_t(kRays * a.steps));
        for (int64_t v = 0; v < a.views; ++v)
            for (int64_t i = begin; i < end; ++i)
                look(a, v, i, &sum[std::size_t((i - begin) * a.steps)], &count[std::size_t((i - begin) * a.steps)]);
        for (int64_t i = begin; i < end; ++i) {
            const float *s = &sum[std::size_t((i - begin) * a.steps)], *m = &count[std::size_t((i - begin) * a.steps)];
            c.best[i] = 0;
            c.cost[i] = 1;
            for (int64_t d = 0; d < a.steps; ++d)
                if (m[d] > 0 && s[d] / m[d] < c.cost[i]) {
                    c.best[i] = d;
                    c.cost[i] = s[d] / m[d];
                }
        }
    }, &c);
}

}  // namespace p2gs
