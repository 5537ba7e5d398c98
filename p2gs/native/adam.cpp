#include "adam.h"

#include "kernels.h"
#include "pool.h"

namespace p2gs {

void adam_step(const AdamTensor* tensors, int count, int threads) {
    constexpr int64_t kChunk = 1 << 14;
    struct Context {
        const AdamTensor* tensors;
        int count;
        void (*step)(const AdamTensor&, int64_t, int64_t);
    } c{tensors, count, kernels().adam.step};
    int64_t chunks = 0;
    for (int i = 0; i < count; ++i) chunks += (tensors[i].size + kChunk - 1) / kChunk;
    parallel_for(
        int(chunks), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            int64_t k = chunk;
            for (int i = 0; i < c.count; ++i) {
                const AdamTensor& t = c.tensors[i];
                int64_t n = (t.size + kChunk - 1) / kChunk;
                if (k < n) {
                    int64_t end = (k + 1) * kChunk;
                    c.step(t, k * kChunk, end < t.size ? end : t.size);
                    return;
                }
                k -= n;
            }
        },
        &c);
}

}  // namespace p2gs
