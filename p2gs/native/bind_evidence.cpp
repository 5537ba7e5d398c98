#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "evidence.h"

namespace p2gs {

void bind_evidence(nb::module_& m) {
    m.def(
        "evidence_effective",
        [](const std::array<Address, 5>& at, int64_t points, float margin, float shared, Address rows, int64_t count, Address out,
           int threads) {
            nb::gil_scoped_release release;
            evidence_effective({pointer<const float>(at[0]), pointer<const float>(at[1]), pointer<const int64_t>(at[2]),
                                pointer<const uint8_t>(at[3]), pointer<const float>(at[4]), points, margin, shared},
                               pointer<const int64_t>(rows), count, pointer<float>(out), threads);
        },
        "out [count, points]: rows int64 [count] of pays less what rivals own. addresses: pays, back float32, twin int64, owned uint8 "
        "[B, points], and what rivals pay for the other state's samples.");
    m.def(
        "evidence_shares",
        [](Address evidence, Address weights, Address loose, Address rows, int64_t count, int64_t points, Address out) {
            evidence_shares(pointer<const float>(evidence), pointer<const float>(weights), pointer<const uint8_t>(loose),
                            pointer<const int64_t>(rows), count, points, pointer<float>(out));
        },
        "out [2, count] of evidence [count, points], count > 0: what each row has of the points it pays most for, times weights [points], on "
        "surfaces of known and of unknown fate; loose uint8 [B, points] of the pool, rows int64 [count].");
    m.def(
        "evidence_joints",
        [](Address surfels, int64_t size, Address index, int64_t points, Address pays, Address axis, Address centre, int64_t motions,
           int64_t few, Address out, int threads) {
            evidence_joints({pointer<const float>(surfels), size, pointer<const int64_t>(index), pointer<const float>(pays),
                             pointer<const float>(axis), pointer<const float>(centre), points},
                            motions, few, pointer<float>(out), threads);
        },
        WithoutGil(),
        "out [motions, 4] over rows index [points] of surfels [size, 12] that each motion pays more than 0.1 for (pays [motions, points]): "
        "sum of distances from its axis, oblique normals, points, distance of the few-th nearest.");
}

}  // namespace p2gs
