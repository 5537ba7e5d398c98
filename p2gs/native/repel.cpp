#include "repel.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {

void repel_local(RepelArgs args, const float* sources, int64_t count, int threads) {
    std::vector<int32_t> order(std::size_t(count), 0);
    for (int64_t i = 0; i < count; ++i) order[std::size_t(i)] = int32_t(i);
    std::sort(order.begin(), order.end(), [&](int32_t i, int32_t j) {
        return sources[3 * int64_t(i)] != sources[3 * int64_t(j)] ? sources[3 * int64_t(i)] < sources[3 * int64_t(j)] : i < j;
    });
    args.padded = count + 16;  // a whole vector of any instruction set may begin at the last one
    std::vector<float> planes(std::size_t(3 * args.padded), INFINITY);
    for (int c = 0; c < 3; ++c)
        for (int64_t i = 0; i < count; ++i) planes[std::size_t(c * args.padded + i)] = sources[3 * int64_t(order[std::size_t(i)]) + c];
    args.sources = planes.data();
    parallel_for(int((args.n + kRepelChunk - 1) / kRepelChunk), threads, [](int chunk, int, void* p) {
        const RepelArgs& a = *static_cast<const RepelArgs*>(p);
        kernels().repel.local(a, chunk * kRepelChunk, std::min((chunk + 1) * kRepelChunk, a.n));
    }, &args);
}

}  // namespace p2gs
