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

// Visible Gaussians by the bits of their depth, near to far, equal depths in the order given. Returns their number; ids in the low halves of s.a.
uint32_t sort_by_depth(const RasterFrame& f, SortBuffers& s) {
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
    const int passes = (bits + 11) / 12, digit = (bits + passes - 1) / passes, buckets = 1 << digit;
    const uint32_t digit_mask = uint32_t(buckets - 1);
    reserve(s.counts, s.counts_size, size_t(passes) << digit);
    std::memset(s.counts, 0, sizeof(uint32_t) * (size_t(passes) << digit));
    for (int c = 0; c < f.chunks; ++c) {
        const uint32_t* keys = f.keys + size_t(c) * kChunk;
        for (uint32_t i = 0; i < f.visible[c]; ++i)
            for (int p = 0; p < passes; ++p) ++s.counts[(size_t(p) << digit) + (((keys[i] - low) >> (p * digit)) & digit_mask)];
    }
    for (int p = 0; p < passes; ++p) {
        uint32_t at = 0, *counts = s.counts + (size_t(p) << digit);
        for (int b = 0; b < buckets; ++b) {
            uint32_t n = counts[b];
            counts[b] = at;
            at += n;
        }
    }
    for (int c = 0; c < f.chunks; ++c) {
        const uint32_t *keys = f.keys + size_t(c) * kChunk, *ids = f.ids + size_t(c) * kChunk;
        for (uint32_t i = 0; i < f.visible[c]; ++i) {
            uint32_t key = keys[i] - low;
            s.a[s.counts[key & digit_mask]++] = uint64_t(key) << 32 | ids[i];
        }
    }
    for (int p = 1; p < passes; ++p) {
        uint32_t* counts = s.counts + (size_t(p) << digit);
        const int shift = 32 + p * digit;
        for (uint32_t i = 0; i < count; ++i) s.b[counts[(s.a[i] >> shift) & digit_mask]++] = s.a[i];
        std::swap(s.a, s.b);
        std::swap(s.a_size, s.b_size);
    }
    return count;
}

// The pairs of all Gaussians, in depth order, into the lists of their tiles.
void scatter(RasterFrame& f, const uint64_t* order, uint32_t count, uint32_t* cursor) {
    const uint32_t ahead = 8;
    for (uint32_t i = 0; i < count; ++i) {
        if (i + 2 * ahead < count) {
            uint32_t next = uint32_t(order[i + 2 * ahead]);
            __builtin_prefetch(&f.pair_range[next]);
        }
        if (i + ahead < count) {
            uint32_t next = uint32_t(order[i + ahead]);
            __builtin_prefetch(f.pairs[next / kChunk].data + f.pair_range[next].begin);
        }
        const uint32_t g = uint32_t(order[i]), chunk = g / kChunk, begin = f.pair_range[g].begin, stop = f.pair_range[g].count;
        const RasterPair* pairs = f.pairs[chunk].data + begin;
        const uint32_t slot = f.chunk_slot[chunk] + begin;
        for (uint32_t k = 0; k < stop; ++k) f.entries[cursor[pairs[k].tile]++] = {pairs[k].mask, g, slot + k};
    }
}

}  // namespace

Frame::~Frame() {
    for (size_t c = 0; c < pairs_size; ++c) std::free(pairs[c].data);
    void* all[] = {records, pair_range, pairs, chunk_slot, keys, ids, visible, tile_begin, tile_end, tile_blocks, entries, slots,
                   slot_used, slopes_memory, sort.a, sort.b, sort.counts, tile_counts};
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
    reserve(tile_counts, tile_counts_size, tiles * size_t(threads));
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
    reserve(entries, entries_size, size_t(total));
    uint32_t at = 0;
    for (size_t t = 0; t < tiles; ++t) {
        tile_begin[t] = at;
        for (int k = 0; k < threads; ++k) at += tile_counts[size_t(k) * tiles + t];
    }
    tile_begin[tiles] = at;
    std::memcpy(tile_counts, tile_begin, sizeof(uint32_t) * tiles);
    const uint32_t count = sort_by_depth(*this, sort);
    scatter(*this, sort.a, count, tile_counts);

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
}

}  // namespace p2gs
