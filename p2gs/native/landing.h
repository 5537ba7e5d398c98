// Part discovery: what surfels of one state meet when motions carry them into the other, a look-up per motion and surfel.
#pragma once

#include <cstdint>

#include "motions.h"

namespace p2gs {

constexpr int kSurfel = 12;  // floats of a surfel: point, normal, colour, 1 where it is known to be static, two unused

// One state as p2gs.motion.discovery.fields.Landing describes it.
struct LandingTables {
    const int32_t* nearest;   // [27][coarse voxels] a surfel
    const float* depth_free;  // [fine voxels]
    const float* surfels;     // [surfel][kSurfel]
    const float* claimed;     // [surfel], or null
    float lo[3];              // corner of both grids
    float h, hc;              // edges of their voxels, fine and coarse
    float tp, spacing, hidden, on_static, two_sided;
    int32_t fine[3], coarse[3];  // voxels by axis
};

// Who travels: rows `index` [count] of `surfels` [size].
struct Travellers {
    const float* surfels;
    int64_t size;
    const int64_t* index;
    int64_t count;
};

// Point-to-plane residuals of travellers that weigh `weights`, Geman-McClure of `width`, where they land within `reach` of a surfel.
struct PlaneFit {
    const float* weights;
    float width, reach;
    bool back;  // the travellers are at rest, and the planes carried to them
};

constexpr int kFitSums = 20;  // upper triangle of J^T W J [5, 5] by rows, then J^T W r [5]

struct LandingKernels {
    // Travellers [begin, end) under motions [first, last): cost [motion][traveller] and the surfel met, rows of from.count.
    // matrices: [motion][12], rows of rotation and translation. thick: [motion] thickness of the plate that moves, 0: one side only.
    void (*cost)(const LandingTables&, const float* matrices, const float* thick, int64_t first, int64_t last, const Travellers& from,
                 int64_t begin, int64_t end, float* cost, int64_t* met);
    // Sums over all travellers under one motion. forward: as matrix, start -> end; basis: [6][5] twists by coordinate.
    void (*fit)(const LandingTables&, const float* matrix, const float* forward, const float* basis, const Travellers& from,
                const PlaneFit& fit, float* sums);
};

// Both raise std::out_of_range for an index that is none of `from.size` rows.
// cost [B, count] and met [B, count]; back: by the inverse motions; thick [B]. The same bits for any number of threads.
void landing_cost(const LandingTables& to, const MotionBatch& motions, const float* thick, bool back, const Travellers& from, float* cost,
                  int64_t* met, int threads);

// Adds J^T W J to A [B, 5, 5] and J^T W r to b [B, 5]; basis: [B, 6, 5].
void landing_fit(const LandingTables& to, const MotionBatch& motions, const float* basis, const Travellers& from, const PlaneFit& fit,
                 float* A, float* b, int threads);

}  // namespace p2gs
