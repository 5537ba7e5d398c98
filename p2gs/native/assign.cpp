#include "assign.h"

#include <cstddef>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

int chunks_of(const AssignArgs& args) { return int((args.n + kAssignChunk - 1) / kAssignChunk); }

}  // namespace

void assign_forward(const AssignArgs& args, int threads) {
    AssignArgs a = args;
    parallel_for(chunks_of(a), threads, [](int chunk, int, void* p) { kernels().assign.forward(*static_cast<AssignArgs*>(p), chunk); }, &a);
}

void assign_backward(AssignArgs args, float* v_weight, float* v_bias, int threads) {
    const int chunks = chunks_of(args), row = args.dim + 1;
    std::vector<float> sums(std::size_t(chunks) * args.parts * row);
    args.sums = sums.data();
    parallel_for(chunks, threads, [](int chunk, int, void* p) { kernels().assign.backward(*static_cast<AssignArgs*>(p), chunk); }, &args);
    std::vector<double> total(std::size_t(args.parts) * row);
    for (int c = 0; c < chunks; ++c)
        for (std::size_t i = 0; i < total.size(); ++i) total[i] += sums[c * total.size() + i];
    for (int k = 0; k < args.parts; ++k) {
        for (int d = 0; d < args.dim; ++d) v_weight[k * args.dim + d] = float(total[std::size_t(k) * row + d]);
        v_bias[k] = float(total[std::size_t(k) * row + args.dim]);
    }
}

}  // namespace p2gs
