#pragma once

#include <cstdint>

namespace p2gs {

// Points in leaves of 16 along a space-filling curve, under boxes of boxes, 16 to a node: one vector register tests a whole node.
constexpr int kKnnWidth = 16;
constexpr int kKnnLevels = 8;

struct KnnTree {
    int levels;                      // of boxes; 0: a single leaf
    const float* leaves;             // [leaf][3][16] coordinates, infinite where there is no point
    const int32_t* ids;              // [leaf][16], -1 where there is no point
    const float* boxes[kKnnLevels];  // level l: [node][6][16], lower and upper corners of its children, infinite where there is none
};

struct KnnKernels {
    // Queries [begin, end) of `queries` [M, 3]; `own_points`: query i is the i-th point along the curve instead (ids[i]), and skips
    // itself when exclude_self. Rows of k squared distances and indices; ties go to the lower index.
    void (*query)(const KnnTree&, const float* queries, bool own_points, bool exclude_self, int64_t begin, int64_t end, int k,
                  float* distance, int64_t* index);
};

// distance [M, k], index [M, k], nearest first. queries may be null: the points themselves. All coordinates below 1e18, k <= points
// (k < points when exclude_self).
void knn(const float* points, int64_t count, const float* queries, int64_t query_count, int k, bool exclude_self, float* distance,
         int64_t* index, int threads);

}  // namespace p2gs
