// What motions explain of sampled points: how much of it stands beside rivals, and what a joint there would look like.
#pragma once

#include <cstdint>

namespace p2gs {

// One state's evidence of every motion in a pool, rows of `points`: what it pays for a point, the other state's sample where the point
// lands, what it pays there, and whether that place is known to have moved; and by sample of the other state, what the best rival pays.
struct PoolState {
    const float *pays, *back;
    const int64_t* twin;
    const uint8_t* owned;
    const float* rival;
    int64_t points;
    float margin, shared;  // by how much a rival must pay more to own the place, and what is lost then
};

// Points [count] with their normals as rows `index` of surfels [12], and what motions [B] pay for them [B, count].
struct JointPoints {
    const float* surfels;
    int64_t size;
    const int64_t* index;
    const float *pays, *axis, *centre;
    int64_t count;
};

struct EvidenceKernels {
    // Row `row` of the pool less what rivals own: out [points].
    void (*effective)(const PoolState&, int64_t row, float* out);
    // Points that motion b pays for: distance from its axis (else infinite) [count]; sums: distance, oblique normals, points.
    void (*joint)(const JointPoints&, int64_t b, float* away, float* sums);
};

// out [rows, points]
void evidence_effective(const PoolState& state, const int64_t* rows, int64_t count, float* out, int threads);

// The set `rows` [count] of a pool with evidence [count, points], points weighted: every point goes to the row that pays most. out
// [2, count]: by row, what it has on surfaces of known and of unknown fate (loose [B, points]).
void evidence_shares(const float* evidence, const float* weights, const uint8_t* loose, const int64_t* rows, int64_t count,
                     int64_t points, float* out);

// out [B, 4]: sums over the points paid for of distance from the axis, oblique normals, points; and the distance that `few` points are
// within (infinite where fewer pay). Raises std::out_of_range for an index that is none of `size` rows.
void evidence_joints(const JointPoints& points, int64_t motions, int64_t few, float* out, int threads);

}  // namespace p2gs
