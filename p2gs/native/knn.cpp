#include "knn.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "pool.h"

namespace p2gs {
namespace {

constexpr int kBits = 21;  // of the curve, an axis: one point a thousand times farther out than the others leaves them 2000 cells

// Bits of x, two places apart.
uint64_t spread(uint64_t x) {
    x = (x | x << 32) & 0x1f00000000ffff;
    x = (x | x << 16) & 0x1f0000ff0000ff;
    x = (x | x << 8) & 0x100f00f00f00f00f;
    x = (x | x << 4) & 0x10c30c30c30c30c3;
    x = (x | x << 2) & 0x1249249249249249;
    return x;
}

struct Item {
    uint64_t key;
    int32_t id;
};

// By key, ties in the order given.
void radix_sort(std::vector<Item>& items) {
    constexpr int kDigit = 11, kBuckets = 1 << kDigit;
    std::vector<Item> other(items.size());
    for (int shift = 0; shift < 3 * kBits; shift += kDigit) {
        uint32_t start[kBuckets + 1] = {};
        for (const Item& i : items) ++start[(i.key >> shift) % kBuckets + 1];
        if (std::find(start, start + kBuckets + 1, items.size()) != start + kBuckets + 1) continue;  // all alike in this digit
        for (int b = 0; b < kBuckets; ++b) start[b + 1] += start[b];
        for (const Item& i : items) other[start[(i.key >> shift) % kBuckets]++] = i;
        items.swap(other);
    }
}

std::vector<Item> along_the_curve(const float* points, int64_t count) {
    float lower[3] = {INFINITY, INFINITY, INFINITY}, upper[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (int64_t i = 0; i < count; ++i)
        for (int c = 0; c < 3; ++c) {
            lower[c] = std::min(lower[c], points[3 * i + c]);
            upper[c] = std::max(upper[c], points[3 * i + c]);
        }
    double extent = 0;
    for (int c = 0; c < 3; ++c) extent = std::max(extent, double(upper[c]) - lower[c]);
    const double scale = extent > 0 ? ((1 << kBits) - 1) / extent : 0;
    std::vector<Item> items(count);
    for (int64_t i = 0; i < count; ++i) {
        uint64_t key = 0;
        for (int c = 0; c < 3; ++c) key |= spread(uint64_t((double(points[3 * i + c]) - lower[c]) * scale)) << c;
        items[i] = {key, int32_t(i)};
    }
    radix_sort(items);
    return items;
}

struct Storage {
    std::vector<float> leaves, boxes[kKnnLevels];
    std::vector<int32_t> ids;
    KnnTree tree{};
};

// boxes[level][node]: corners of child `slot` start at infinity, inside out where there is no child.
void add_level(std::vector<float>& boxes, int64_t children) {
    boxes.assign((children + kKnnWidth - 1) / kKnnWidth * 6 * kKnnWidth, INFINITY);
}

void build(Storage& s, const float* points, int64_t count) {
    const std::vector<Item> items = along_the_curve(points, count);
    int64_t nodes = (count + kKnnWidth - 1) / kKnnWidth;
    s.leaves.assign(nodes * 3 * kKnnWidth, INFINITY);
    s.ids.assign(nodes * kKnnWidth, -1);
    for (int64_t i = 0; i < count; ++i) {
        const int64_t leaf = i / kKnnWidth, slot = i % kKnnWidth;
        s.ids[i] = items[i].id;
        for (int c = 0; c < 3; ++c) s.leaves[(leaf * 3 + c) * kKnnWidth + slot] = points[3 * int64_t(items[i].id) + c];
    }
    int level = 0;
    for (; nodes > 1; ++level) {
        add_level(s.boxes[level], nodes);
        for (int64_t child = 0; child < nodes; ++child) {
            // corner c of the child, over its points (level 0) or its own children's boxes
            for (int c = 0; c < 3; ++c) {
                float lower = INFINITY, upper = -INFINITY;
                for (int i = 0; i < kKnnWidth; ++i) {
                    float low, high;
                    if (level == 0) {
                        low = high = s.leaves[(child * 3 + c) * kKnnWidth + i];
                    } else {
                        const float* box = s.boxes[level - 1].data() + child * 6 * kKnnWidth;
                        low = box[c * kKnnWidth + i];
                        high = box[(3 + c) * kKnnWidth + i];
                    }
                    if (std::isinf(low)) continue;
                    lower = std::min(lower, low);
                    upper = std::max(upper, high);
                }
                float* box = s.boxes[level].data() + child / kKnnWidth * 6 * kKnnWidth + child % kKnnWidth;
                box[c * kKnnWidth] = lower;
                box[(3 + c) * kKnnWidth] = upper;
            }
        }
        nodes = (nodes + kKnnWidth - 1) / kKnnWidth;
    }
    s.tree.levels = level;
    s.tree.leaves = s.leaves.data();
    s.tree.ids = s.ids.data();
    for (int l = 0; l < level; ++l) s.tree.boxes[l] = s.boxes[l].data();
}

}  // namespace

void knn(const float* points, int64_t count, const float* queries, int64_t query_count, int k, bool exclude_self, float* distance,
         int64_t* index, int threads) {
    constexpr int64_t kChunk = 256;
    Storage storage;
    build(storage, points, count);
    struct Context {
        const KnnTree& tree;
        void (*query)(const KnnTree&, const float*, bool, bool, int64_t, int64_t, int, float*, int64_t*);
        const float* queries;
        int64_t total;
        int k;
        bool exclude_self;
        float* distance;
        int64_t* index;
    } context{storage.tree, kernels().knn.query, queries, queries ? query_count : count, k, exclude_self, distance, index};
    parallel_for(
        int((context.total + kChunk - 1) / kChunk), threads,
        [](int chunk, int, void* p) {
            const Context& c = *static_cast<const Context*>(p);
            const int64_t begin = chunk * kChunk, end = std::min(begin + kChunk, c.total);
            c.query(c.tree, c.queries, !c.queries, c.exclude_self, begin, end, c.k, c.distance, c.index);
        },
        &context);
}

}  // namespace p2gs
