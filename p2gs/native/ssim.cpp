#include "ssim.h"

#include <algorithm>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

int ssim_padded(int n) { return (n + 15) / 16 * 16; }

double l1_ssim(SsimArgs args, float lam, bool have_target, int threads) {
    // Every cut costs ten rows done twice; two pieces a thread leave something to share when one of them is held up.
    const int pieces = threads > 1 ? 2 * threads : 1;
    const int piece = std::max(32, ((args.rows + pieces - 1) / pieces + 3) / 4 * 4);
    const int chunks = (args.rows + piece - 1) / piece;
    threads = std::min(threads, chunks);
    const int64_t scratch = int64_t(15) * (args.padded + 2 * kSsimMargin) + int64_t(3) * kSsimRing * args.padded;

    // Kept between calls: fresh pages cost more than the arithmetic.
    thread_local std::vector<float> work;
    thread_local std::vector<double> sums;
    work.assign(size_t(args.padded + threads * scratch), 0.0f);
    sums.assign(size_t(2) * args.rows, 0.0);
    args.zeros = work.data();
    const double count = double(args.rows) * args.n;
    args.l1_weight = float((1.0 - lam) / count);
    args.ssim_weight = float(-lam / count);

    struct Context {
        const SsimArgs& args;
        const SsimKernels& kernel;
        int piece;
        float* scratch;
        int64_t scratch_size;
        double* sums;
        int begin(int chunk) const { return chunk * piece; }
        int end(int chunk) const { return std::min((chunk + 1) * piece, args.rows); }
        float* scratch_of(int thread) const { return scratch + thread * scratch_size; }
    } context{args, kernels().ssim, piece, work.data() + args.padded, scratch, sums.data()};

    auto target = [](int chunk, int thread, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.kernel.target(c.args, c.begin(chunk), c.end(chunk), c.scratch_of(thread));
    };
    auto loss = [](int chunk, int thread, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.kernel.loss(c.args, c.begin(chunk), c.end(chunk), c.scratch_of(thread), c.sums);
    };
    if (!have_target) parallel_for(chunks, threads, target, &context);
    parallel_for(chunks, threads, loss, &context);

    double ssim = 0, l1 = 0;
    for (int y = 0; y < args.rows; ++y) ssim += sums[2 * y], l1 += sums[2 * y + 1];
    return (1.0 - lam) * l1 / count + lam * (1.0 - ssim / count);
}

}  // namespace p2gs
