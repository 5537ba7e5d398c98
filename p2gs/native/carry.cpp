#include "carry.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "pool.h"
#include "quaternion.h"

namespace p2gs {
namespace {

// The bases of band 1, 2 or 3 at a unit direction, as p2gs.ops.sh has them.
void basis(int band, const double* d, double* out) {
    const double pi = 3.14159265358979323846, x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
    if (band == 1) {
        const double c = std::sqrt(3 / (4 * pi));
        out[0] = -c * y, out[1] = c * z, out[2] = -c * x;
    } else if (band == 2) {
        const double c = std::sqrt(15 / (4 * pi));
        out[0] = c * x * y, out[1] = -c * y * z, out[2] = std::sqrt(5 / (16 * pi)) * (2 * zz - xx - yy);
        out[3] = -c * x * z, out[4] = 0.5 * c * (xx - yy);
    } else {
        const double c0 = std::sqrt(7 / (16 * pi)), c1 = std::sqrt(21 / (32 * pi)), c2 = std::sqrt(105 / (4 * pi));
        const double c3 = std::sqrt(35 / (32 * pi)), ring = 4 * zz - xx - yy;
        out[0] = -c3 * y * (3 * xx - yy), out[1] = c2 * x * y * z, out[2] = -c1 * y * ring;
        out[3] = c0 * z * (2 * zz - 3 * xx - 3 * yy), out[4] = -c1 * x * ring;
        out[5] = 0.5 * c2 * z * (xx - yy), out[6] = -c3 * x * (xx - 3 * yy);
    }
}

CarryMotion motion(const float* T, int bases, const double* tables) {
    CarryMotion m = {};
    double R[3][3], q[4];
    for (int i = 0; i < 12; ++i) m.rigid[i] = T[i];
    for (int i = 0; i < 9; ++i) R[i / 3][i % 3] = T[4 * (i / 3) + i % 3];
    quaternion(R, q);
    std::copy(q, q + 4, m.quat);
    float* out = m.bands;
    for (int band = 1; band * band < bases; ++band) {
        const int side = 2 * band + 1, count = 4 * band + 8;
        const double *directions = tables, *inverse = tables + 3 * count;
        double turned[20][7];
        for (int i = 0; i < count; ++i) {  // the turned function at d is the old one at R^T d
            double d[3];
            for (int c = 0; c < 3; ++c)
                d[c] = directions[3 * i] * R[0][c] + directions[3 * i + 1] * R[1][c] + directions[3 * i + 2] * R[2][c];
            basis(band, d, turned[i]);
        }
        for (int r = 0; r < side; ++r)
            for (int c = 0; c < side; ++c) {
                double sum = 0;
                for (int i = 0; i < count; ++i) sum += inverse[r * count + i] * turned[i][c];
                *out++ = float(sum);
            }
        tables = inverse + side * count;
    }
    return m;
}

}  // namespace

void carry(const CarryArgs& args, const float* transforms, const double* tables, const int64_t* starts, int parts, int threads) {
    constexpr int64_t kRows = 512;  // of a chunk
    struct Chunk {
        int part;
        int64_t begin, end;
    };
    std::vector<CarryMotion> motions(parts);
    std::vector<Chunk> chunks;
    for (int k = 0; k < parts; ++k) {
        motions[k] = motion(transforms + 16 * k, args.bases, tables);
        for (int64_t i = starts[k]; i < starts[k + 1]; i += kRows) chunks.push_back({k, i, std::min(i + kRows, starts[k + 1])});
    }
    struct Context {
        decltype(CarryKernels::rows) kernel;
        const CarryArgs& args;
        const CarryMotion* motions;
        const Chunk* chunks;
    } context{kernels().carry.rows, args, motions.data(), chunks.data()};
    parallel_for(
        int(chunks.size()), threads,
        [](int i, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const Chunk& chunk = c.chunks[i];
            c.kernel(c.args, c.motions[chunk.part], chunk.begin, chunk.end);
        },
        &context);
}

}  // namespace p2gs
