// The driver's side of a frame: owns the memory, which only grows, so that the next view of the same size allocates nothing.
#pragma once

#include <cstddef>

#include "raster.h"

namespace p2gs {

struct SortBuffers {
    uint64_t *a = nullptr, *b = nullptr;  // key << 32 | id
    uint32_t* counts = nullptr;
    size_t a_size = 0, b_size = 0, counts_size = 0;
};

struct Frame : RasterFrame {
    Frame() : RasterFrame{} {}
    ~Frame();
    Frame(const Frame&) = delete;
    Frame& operator=(const Frame&) = delete;

    // Throw std::bad_alloc where memory does not suffice. Results have the same bits for any number of threads.
    // keep: there will be a backward pass (on the kernels of the same instruction set).
    void forward(const RasterArgs& a, bool keep, int threads);
    void backward(const RasterArgs& a, const RasterGrads& g, int threads);

    const RasterKernels* table = nullptr;
    SortBuffers sort;
    float *slopes_memory = nullptr, *pulls_memory = nullptr;
    uint32_t* tile_counts = nullptr;
    size_t records_size = 0, pair_range_size = 0, pairs_size = 0, chunk_slot_size = 0, keys_size = 0, ids_size = 0,
           visible_size = 0, tile_begin_size = 0, tile_end_size = 0, entries_size = 0, slots_size = 0, slot_used_size = 0,
           tile_counts_size = 0, slopes_size = 0, tile_blocks_size = 0, pulls_size = 0;
};

}  // namespace p2gs
