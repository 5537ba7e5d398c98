// Labels that agree among neighbours: costs diffused over a graph of k neighbours a node, and a mean-field Potts model on it.
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kGraphColumns = 32;  // at most, of a labelling

struct Graph {
    const int32_t* neighbours;  // [N][k]
    const float* weights;       // [N][k]
    int64_t nodes;
    int k, columns, stride;  // stride: columns, padded to whole vectors
};

// Rows [begin, end) of [N][stride] tables; A: the graph's matrix.
struct GraphKernels {
    int width;  // floats of a vector
    // out = share * A in + (1 - share) * own; own may be null where share is 1
    void (*average)(const Graph&, const float* in, const float* own, float share, float* out, int64_t begin, int64_t end);
    // out = softmax(pull * A in - sharp * cost) over the columns; in may be null: nothing pulls
    void (*field)(const Graph&, const float* in, const float* cost, float pull, float sharp, float* out, int64_t begin, int64_t end);
};

struct LabelModel {
    int diffuse, rounds;
    float pull, sharp;
};

// values and out [N, columns]: out = A values. The same bits for any number of threads, here and below.
void graph_average(Graph graph, const float* values, float* out, int threads);

// cost and out [N, columns]: cost is averaged `diffuse` times with its neighbours' and itself, then probabilities settle in `rounds`.
void graph_labels(Graph graph, const float* cost, const LabelModel& model, float* out, int threads);

}  // namespace p2gs
