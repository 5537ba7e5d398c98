#include "image.h"

#include <algorithm>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

// The sum of kernel(args, begin, end) over chunks, in their order.
template <class Args>
double sum_of(double (*kernel)(const Args&, int64_t, int64_t), const Args& args, int64_t n, int threads) {
    struct Context {
        double (*kernel)(const Args&, int64_t, int64_t);
        const Args& args;
        int64_t n;
        std::vector<double> sums;
    } c{kernel, args, n, std::vector<double>(size_t((n + kPixels - 1) / kPixels))};
    parallel_for(int(c.sums.size()), threads, [](int chunk, int, void* p) {
        Context& c = *static_cast<Context*>(p);
        c.sums[chunk] = c.kernel(c.args, chunk * kPixels, std::min((chunk + 1) * kPixels, c.n));
    }, &c);
    double total = 0;
    for (double s : c.sums) total += s;
    return total;
}

}  // namespace

double cross_entropy(const CrossEntropy& args, int64_t n, int threads) { return sum_of(kernels().image.cross_entropy, args, n, threads); }
double depth_spread(const DepthSpread& args, int64_t n, int threads) { return sum_of(kernels().image.depth_spread, args, n, threads); }

void compose(const Compose& args, int64_t n, int threads) {
    struct Context {
        const Compose& args;
        int64_t n;
    } c{args, n};
    parallel_for(int((n + kPixels - 1) / kPixels), threads, [](int chunk, int, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        kernels().image.compose(c.args, chunk * kPixels, std::min((chunk + 1) * kPixels, c.n));
    }, &c);
}

int64_t count_inside(const float* target, int64_t n) {
    int64_t count = 0;
    for (int64_t begin = 0; begin < n; begin += kPixels) {  // 32-bit counts within a chunk vectorise
        int32_t some = 0;
        const int64_t end = std::min(begin + kPixels, n);
        for (int64_t i = begin; i < end; ++i) some += target[i] > 0.5f;
        count += some;
    }
    return count;
}

}  // namespace p2gs
