// Gaussian rasterization: what the stages share. A view is cut into tiles of 32 x 32 pixels, a tile into 64 blocks of 4 x 4.
//
//   project   per chunk of Gaussians: image-plane record, colour, and for every tile touched the set of blocks touched
//   (driver)  radix sort of the visible Gaussians by depth, scatter of their (Gaussian, tile) pairs into the tiles' lists
//   forward   per tile: front-to-back blending; remembers which blocks each pair really used
//   backward  per tile: the same walk again, near to far; one slot of gradients per (Gaussian, tile) pair
//   reduce    per chunk of Gaussians: sum of the slots in fixed order, gradient of the projection
#pragma once

#include <cstdint>

namespace p2gs {

constexpr int kTile = 32;          // pixels
constexpr int kBlocks = 64;        // per tile, row by row
constexpr int kChunk = 512;        // Gaussians
constexpr int kMaxFeatures = 16;
constexpr int kSlopes = 12;        // per Gaussian and channel: 1 or 0 (not clamped, clamped), then d colour / d direction
constexpr int kSlot = 16;          // floats of a gradient slot before the features
constexpr int kPull = 15;          // sums of a chunk's gradients by the camera: 9 rotation, 3 translation, 3 by the camera's centre
constexpr float kMinAlpha = 1.0f / 255, kMaxAlpha = 0.99f, kStop = 1e-4f, kFar = 1e10f;
constexpr float kFaint = 7.99435344f;  // -log2(kMinAlpha)

// A Gaussian in the image plane. With d = pixel - (mx, my): u = l11 dx + l21 dy, v = l22 dy (Cholesky factor of the inverse
// covariance, scaled), and alpha = 2^(lop - u^2 - v^2).
struct alignas(64) RasterRecord {
    float mx, my, l11, l21, l22, lop;
    float r, g, b, z, zz;  // zz = (z - depth_ref)^2
    float spare[5];
};

// Bit 8 row + column of `mask`: that block of the tile.
struct RasterPair {
    uint64_t mask;
    uint32_t tile, spare;
};

// A Gaussian's pairs: `count` from `begin` on within its chunk's.
struct RasterRange {
    uint32_t begin, count;
};

struct RasterEntry {
    uint64_t mask;
    uint32_t gaussian, slot;
};

struct RasterPairs {
    RasterPair* data;
    uint32_t count, capacity;
};

struct RasterArgs {
    int64_t n;
    const float *means, *quats, *scales, *opacities, *sh, *features;
    const float* sh_rest;  // null: sh holds all bases; else sh holds the constant one and this the others
    bool stored;           // scales are logarithms and opacities logits
    int sh_bases, sh_degree, num_features;
    float view[12];  // rows of world -> camera
    float fx, fy, cx, cy, near_plane, eps2d, depth_ref;
    bool antialias;  // opacities lose what eps2d adds to the area
    int width, height;
    const float* background;  // null, 3 floats, or an image
    bool background_image;
    // outputs; depth_sq, median and features_out may be null
    float *colour, *alpha, *depth, *depth_sq, *median, *features_out;
    int32_t* radii;
};

// d loss / d outputs (each may be null) and where d loss / d inputs go (abs_grad, v_features and view may be null).
struct RasterGrads {
    const float *colour, *alpha, *depth, *depth_sq, *features;
    float *means, *quats, *scales, *opacities, *sh, *sh_rest, *v_features, *abs_grad;
    float* view;  // 12, as RasterArgs::view
};

// Working memory of one view, kept from forward to backward.
struct RasterFrame {
    int tiles_x, tiles_y, chunks;
    RasterRecord* records;          // n
    RasterRange* pair_range;        // n
    RasterPairs* pairs;             // chunks
    uint32_t* chunk_slot;           // chunks + 1: slots before the chunk
    float* slopes;                  // kSlopes n, rounded up to whole vectors and in their lanes; null where there will be no backward
    uint32_t *keys, *ids;           // n: visible Gaussians of chunk c from c * kChunk on; bits of their depth
    uint32_t* visible;              // chunks
    uint32_t* tile_begin;           // tiles + 1
    uint64_t* tile_blocks;          // tiles: blocks that any pair may touch
    uint32_t* tile_end;             // tiles: end of what forward looked at
    RasterEntry* entries;           // pairs in all, by tile, near to far
    float* slots;
    float* pulls;                   // kPull a chunk; null where the camera's gradient is not wanted
    uint8_t* slot_used;
    int slot_stride;
    bool out_of_memory;
};

struct RasterKernels {
    void (*project)(const RasterArgs&, RasterFrame&, int chunk, uint32_t* tile_counts);
    void (*forward)(const RasterArgs&, RasterFrame&, int tile);
    void (*backward)(const RasterArgs&, const RasterGrads&, RasterFrame&, int tile);
    void (*reduce)(const RasterArgs&, const RasterGrads&, RasterFrame&, int chunk);
};

}  // namespace p2gs
