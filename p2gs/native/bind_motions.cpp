#include "bind_motions.h"

namespace p2gs {

void bind_motions(nb::module_& m) {
    m.def(
        "motion_matrices",
        [](const Motions& motions, int64_t count, Address R, Address t) {
            motion_matrices(batch(motions, count), pointer<float>(R), pointer<float>(t));
        },
        "R [count, 3, 3] and t [count, 3] of motions (turn uint8, axis, centre, amount).");
    m.def(
        "motion_swept",
        [](const Motions& a, int64_t count, const Motions& b, int64_t others, Address points, int64_t size, Address out) {
            motion_swept(batch(a, count), batch(b, others), pointer<const float>(points), size, pointer<float>(out));
        },
        "Root mean square distance [count, others] between the images of points [size, 3] under motions a and b.");
    m.def(
        "motion_displaced",
        [](const Motions& motions, int64_t count, Address step, Address axis, Address centre, Address amount) {
            motion_displaced(batch(motions, count), pointer<const float>(step), pointer<float>(axis), pointer<float>(centre),
                             pointer<float>(amount));
        },
        "axis, centre and amount of motions after steps [count, 5] in their own coordinates.");
}

}  // namespace p2gs
