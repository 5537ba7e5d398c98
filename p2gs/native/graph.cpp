#include "graph.h"

#include <algorithm>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

constexpr int64_t kRows = 512;  // of a chunk

// step(begin, end) for all rows of the graph.
template <class Step>
void over_rows(int64_t nodes, int threads, const Step& step) {
    struct Context {
        const Step& step;
        int64_t nodes;
    } context{step, nodes};
    parallel_for(
        int((nodes + kRows - 1) / kRows), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            c.step(chunk * kRows, std::min((chunk + 1) * kRows, c.nodes));
        },
        &context);
}

int padded_columns(const Graph& g) {
    const int width = kernels().graph.width;
    return (g.columns + width - 1) / width * width;
}

std::vector<float> padded(const Graph& g, const float* values) {
    std::vector<float> out(size_t(g.nodes) * g.stride);
    for (int64_t i = 0; i < g.nodes; ++i) std::copy_n(values + i * g.columns, g.columns, out.data() + i * g.stride);
    return out;
}

void unpad(const Graph& g, const std::vector<float>& from, float* out) {
    for (int64_t i = 0; i < g.nodes; ++i) std::copy_n(from.data() + i * g.stride, g.columns, out + i * g.columns);
}

}  // namespace

void graph_average(Graph g, const float* values, float* out, int threads) {
    g.stride = padded_columns(g);
    const std::vector<float> in = padded(g, values);
    std::vector<float> mean(in.size());
    const auto kernel = kernels().graph.average;
    over_rows(g.nodes, threads, [&](int64_t begin, int64_t end) { kernel(g, in.data(), nullptr, 1.0f, mean.data(), begin, end); });
    unpad(g, mean, out);
}

void graph_labels(Graph g, const float* values, const LabelModel& model, float* out, int threads) {
    g.stride = padded_columns(g);
    const std::vector<float> cost = padded(g, values);
    std::vector<float> smooth = cost, now(cost.size()), next(cost.size());
    const GraphKernels& k = kernels().graph;
    for (int i = 0; i < model.diffuse; ++i) {
        over_rows(g.nodes, threads,
                  [&](int64_t begin, int64_t end) { k.average(g, smooth.data(), cost.data(), 0.5f, next.data(), begin, end); });
        smooth.swap(next);
    }
    for (int i = 0; i <= model.rounds; ++i) {
        const float* in = i ? now.data() : nullptr;
        over_rows(g.nodes, threads, [&](int64_t begin, int64_t end) {
            k.field(g, in, smooth.data(), model.pull, model.sharp, next.data(), begin, end);
        });
        now.swap(next);
    }
    unpad(g, now, out);
}

}  // namespace p2gs
