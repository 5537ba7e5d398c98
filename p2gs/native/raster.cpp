#include "raster_frame.h"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <new>

#include "kernels.h"
#if defined(__linux__)
#include <sys/mman.h>
#endif
#include "pool.h"

namespace p2gs {
namespace {

// Memory for `bytes`, to be given back by std::free. Large pieces ask for huge pages: the tiles read them in random order.
void* allocate(size_t bytes) {
    constexpr size_t huge = size_t(2) << 20;
    const size_t unit = bytes >= huge ? huge : 64;
    bytes = (bytes + unit - 1) / unit * unit;
    void* p = std::aligned_alloc(unit, bytes);
    if (!p) throw std::bad_alloc();
#if defined(__linux__)
    if (unit == huge) madvise(p, bytes, MADV_HUGEPAGE);  // a hint: whether it is taken does not matter
#endif
    return p;
}

// Contents are lost when it grows.
template <class T>
void reserve(T*& data, size_t& capacity, size_t wanted) {
    if (wanted <= capacity) return;
    std::free(data);
    data = nullptr;
    capacity = 0;
    const size_t grown = wanted + wanted / 4 + 64;
    data = static_cast<T*>(allocate(grown * sizeof(T)));
    capacity = grown;
}

// One pass of the sort over piece k of the input: counted first, then put where the counts of all pieces say.
struct SortPass {
    const RasterFrame& f;
    const uint64_t* from;  // null: the keys and ids of the chunks
    uint64_t* to;
    uint32_t *counts, count, low, mask;  // counts [pieces][mask + 1]
    int pieces, shift, digit, passes;    // passes: counted in one go, their counts behind each other (a single piece stays the same set)

    template <class Each>
    void walk(int k, Each&& each) const {
        if (from) {
            const uint32_t end = uint32_t(uint64_t(count) * (k + 1) / pieces);
            for (uint32_t i = uint32_t(uint64_t(count) * k / pieces); i < end; ++i) each(from[i]);
            return;
        }
        for (int c = f.chunks * k / pieces; c < f.chunks * (k + 1) / pieces; ++c) {
            const uint32_t *keys = f.keys + size_t(c) * kChunk, *ids = f.ids + size_t(c) * kChunk;
            for (uint32_t i = 0; i < f.visible[c]; ++i) each(uint64_t(keys[i] - low) << 32 | ids[i]);
        }
    }
    uint32_t* counts_of(int k) const { return counts + size_t(k) * (mask + 1); }
};

void count_piece(int k, int, void* p) {
    const SortPass& s = *static_cast<const SortPass*>(p);
    uint32_t* counts = s.counts_of(k);
    std::memset(counts, 0, sizeof(uint32_t) * (s.mask + 1) * size_t(s.passes));
    s.walk(k, [&](uint64_t item) {
        for (int p = 0; p < s.passes; ++p) ++counts[p * size_t(s.mask + 1) + (item >> (s.shift + p * s.digit) & s.mask)];
    });
}

void place_piece(int k, int, void* p) {
    const SortPass& s = *static_cast<const SortPass*>(p);
    uint32_t* at = s.counts_of(k);
    s.walk(k, [&](uint64_t item) { s.to[at[item >> s.shift & s.mask]++] = item; });
}

// Visible Gaussians by the bits of their depth, near to far, equal depths in the order given. Returns their number; ids in the low halves of s.a.
uint32_t sort_by_depth(const RasterFrame& f, SortBuffers& s, int pieces) {
    uint32_t low = ~0u, high = 0, count = 0;
    for (int c = 0; c < f.chunks; ++c) {
        const uint32_t* keys = f.keys + size_t(c) * kChunk;
        for (uint32_t i = 0; i < f.visible[c]; ++i) {
            low = std::min(low, keys[i]);
            high = std::max(high, keys[i]);
        }
        count += f.visible[c];
    }
    if (!count) return 0;
    reserve(s.a, s.a_size, count);
    reserve(s.b, s.b_size, count);
    int bits = 1;
    while (bits < 32 && (high - low) >> bits) ++bits;
    const int passes = (bits + 11) / 12, digit = (bits + passes - 1) / passes;
    const uint32_t buckets = 1u << digit;
    reserve(s.counts, s.counts_size, size_t(std::max(pieces, passes)) << digit);
    for (int p = 0; p < passes; ++p) {
        const bool alone = pieces == 1;
        SortPass pass{f, p ? s.a : nullptr, p ? s.b : s.a, s.counts + (alone ? size_t(p) << digit : 0), count, low, buckets - 1, pieces,
                      32 + p * digit, digit, alone ? passes : 1};
        if (!p || !alone) parallel_for(pieces, pieces, count_piece, &pass);
        uint32_t at = 0;
        for (uint32_t b = 0; b < buckets; ++b)
            for (int k = 0; k < pieces; ++k) {
                uint32_t& n = pass.counts_of(k)[b];
                const uint32_t begin = at;
                at += n;
                n = begin;
            }
        parallel_for(pieces, pieces, place_piece, &pass);
        if (p) {
            std::swap(s.a, s.b);
            std::swap(s.a_size, s.b_size);
        }
    }
    return count;
}

// The pairs of all Gaussians, in depth order, into the lists of their tiles. Each piece walks all of them and keeps those of its own tiles;
// the others go to a place that nobody reads (no branch: which tile comes next cannot be foretold).
struct Scatter {
    RasterFrame& f;
    const uint64_t* order;
    uint32_t count, *cursors, *inside, tiles;  // of each piece: where a tile's next entry goes, and whether it is its own (1 or 0)
};

template <bool kAlone>
void scatter_piece(int k, int, void* p) {
    const Scatter& s = *static_cast<const Scatter*>(p);
    const RasterFrame& f = s.f;
    uint32_t *cursor = s.cursors + size_t(k) * s.tiles, *own = s.inside + size_t(k) * s.tiles;
    const uint32_t ahead = 8;
    for (uint32_t i = 0; i < s.count; ++i) {
        if (i + 2 * ahead < s.count) {
            uint32_t next = uint32_t(s.order[i + 2 * ahead]);
            __builtin_prefetch(&f.pair_range[next]);
        }
        if (i + ahead < s.count) {
            uint32_t next = uint32_t(s.order[i + ahead]);
            __builtin_prefetch(f.pairs[next / kChunk].data + f.pair_range[next].begin);
        }
        const uint32_t g = uint32_t(s.order[i]), chunk = g / kChunk, begin = f.pair_range[g].begin, stop = f.pair_range[g].count;
        const RasterPair* pairs = f.pairs[chunk].data + begin;
        const uint32_t slot = f.chunk_slot[chunk] + begin;
        for (uint32_t j = 0; j < stop; ++j) {
            const uint32_t tile = pairs[j].tile;
            f.entries[cursor[tile]] = {pairs[j].mask, g, slot + j};
            cursor[tile] += kAlone ? 1 : own[tile];
        }
    }
}

// `memory`: 2 x pieces x tiles. The entries have 4 x pieces places more than there are pairs.
void scatter(RasterFrame& f, const uint64_t* order, uint32_t count, uint32_t* memory, uint32_t tiles, int pieces) {
    const uint32_t total = f.tile_begin[tiles];
    Scatter s{f, order, count, memory, memory + size_t(pieces) * tiles, tiles};
    for (int k = 0; k < pieces; ++k)
        for (uint32_t t = 0; t < tiles; ++t) {
            // a tile belongs to the piece in whose share of all pairs its first one lies
            const bool mine = !total || int(uint64_t(std::min(f.tile_begin[t], total - 1)) * pieces / total) == k;
            s.inside[size_t(k) * tiles + t] = mine;
            s.cursors[size_t(k) * tiles + t] = mine ? f.tile_begin[t] : total + 4 * k;
        }
    parallel_for(pieces, pieces, pieces == 1 ? scatter_piece<true> : scatter_piece<false>, &s);
}

// The chunks' sums, in double and in order, as the gradient by the rows of world -> camera (R, t). Directions of sight start at the camera's
// centre -R^T t: with s = d loss / d (R^T t), t gets R s and R gets t s^T.
void camera_gradient(const RasterArgs& a, const RasterFrame& f, float* view) {
    double sum[kPull] = {};
    for (int c = 0; c < f.chunks; ++c)
        for (int k = 0; k < kPull; ++k) sum[k] += f.pulls[size_t(c) * kPull + k];
    const double* s = sum + 12;
    for (int r = 0; r < 3; ++r) {
        const float* row = a.view + 4 * r;
        for (int k = 0; k < 3; ++k) view[4 * r + k] = float(sum[3 * r + k] + row[3] * s[k]);
        view[4 * r + 3] = float(sum[9 + r] + row[0] * s[0] + row[1] * s[1] + row[2] * s[2]);
    }
}

}  // namespace

Frame::~Frame() {
    for (size_t c = 0; c < pairs_size; ++c) std::free(pairs[c].data);
    void* all[] = {records, pair_range, pairs, chunk_slot, keys, ids, visible, tile_begin, tile_end, tile_blocks, entries, slots,
                   slot_used, slopes_memory, pulls_memory, sort.a, sort.b, sort.counts, tile_counts};
    for (void* p : all) std::free(p);
}

void Frame::forward(const RasterArgs& a, bool keep, int threads) {
    table = &kernels().raster;
    tiles_x = (a.width + kTile - 1) / kTile;
    tiles_y = (a.height + kTile - 1) / kTile;
    chunks = int((a.n + kChunk - 1) / kChunk);
    const size_t n = size_t(a.n), tiles = size_t(tiles_x) * size_t(tiles_y);
    reserve(records, records_size, n);
    reserve(pair_range, pair_range_size, n);
    if (keep) reserve(slopes_memory, slopes_size, (n + 16) * kSlopes);
    slopes = keep ? slopes_memory : nullptr;
    reserve(keys, keys_size, n);
    reserve(ids, ids_size, n);
    reserve(visible, visible_size, size_t(chunks));
    reserve(chunk_slot, chunk_slot_size, size_t(chunks) + 1);
    reserve(tile_begin, tile_begin_size, tiles + 1);
    reserve(tile_end, tile_end_size, tiles);
    reserve(tile_blocks, tile_blocks_size, tiles);
    // sorting and scattering: a small view is not worth the waking, and beyond a few pieces the walking that each does outweighs its share
    const int pieces = a.n >= 8192 ? std::min(threads, 4) : 1;
    reserve(tile_counts, tile_counts_size, tiles * size_t(std::max(threads, 2 * pieces)));
    if (size_t(chunks) > pairs_size) {
        size_t grown = size_t(chunks) + 8;
        void* p = std::realloc(pairs, grown * sizeof(RasterPairs));
        if (!p) throw std::bad_alloc();
        pairs = static_cast<RasterPairs*>(p);
        std::memset(pairs + pairs_size, 0, (grown - pairs_size) * sizeof(RasterPairs));
        pairs_size = grown;
    }
    out_of_memory = false;
    std::memset(tile_counts, 0, sizeof(uint32_t) * tiles * size_t(threads));

    struct Context {
        const RasterArgs& a;
        Frame& f;
        const RasterKernels& k;
        size_t tiles;
    } c{a, *this, *table, tiles};
    parallel_for(chunks, threads, [](int chunk, int thread, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.k.project(c.a, c.f, chunk, c.f.tile_counts + size_t(thread) * c.tiles);
    }, &c);
    if (out_of_memory) throw std::bad_alloc();

    uint64_t total = 0;
    for (int chunk = 0; chunk < chunks; ++chunk) {
        chunk_slot[chunk] = uint32_t(total);
        total += pairs[chunk].count;
    }
    if (total > 0xffffffffu) throw std::bad_alloc();
    chunk_slot[chunks] = uint32_t(total);
    reserve(entries, entries_size, size_t(total) + 4 * size_t(pieces));
    uint32_t at = 0;
    for (size_t t = 0; t < tiles; ++t) {
        tile_begin[t] = at;
        for (int k = 0; k < threads; ++k) at += tile_counts[size_t(k) * tiles + t];
    }
    tile_begin[tiles] = at;
    const uint32_t count = sort_by_depth(*this, sort, pieces);
    scatter(*this, sort.a, count, tile_counts, uint32_t(tiles), pieces);

    parallel_for(int(tiles), threads, [](int tile, int, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.k.forward(c.a, c.f, tile);
    }, &c);
}

void Frame::backward(const RasterArgs& a, const RasterGrads& g, int threads) {
    const size_t total = chunk_slot[chunks];
    slot_stride = kSlot + (g.features ? kMaxFeatures : 0);
    reserve(slots, slots_size, total * size_t(slot_stride));
    reserve(slot_used, slot_used_size, total);
    std::memset(slot_used, 0, total);
    if (g.view) reserve(pulls_memory, pulls_size, size_t(chunks) * kPull);
    pulls = g.view ? pulls_memory : nullptr;
    struct Context {
        const RasterArgs& a;
        const RasterGrads& g;
        Frame& f;
        const RasterKernels& k;
    } c{a, g, *this, *table};
    parallel_for(tiles_x * tiles_y, threads, [](int tile, int, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.k.backward(c.a, c.g, c.f, tile);
    }, &c);
    parallel_for(chunks, threads, [](int chunk, int, void* p) {
        const Context& c = *static_cast<const Context*>(p);
        c.k.reduce(c.a, c.g, c.f, chunk);
    }, &c);
    if (g.view) camera_gradient(a, *this, g.view);
}

}  // namespace p2gs
