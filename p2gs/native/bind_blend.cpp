#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "blend.h"

namespace p2gs {

void bind_blend(nb::module_& m) {
    m.def(
        "blend_forward",
        [](const std::array<Address, 6>& at, int64_t n, int parts, int threads) {
            BlendArgs a = {};
            a.n = n, a.parts = parts;
            a.means = pointer<const float>(at[0]), a.quats = pointer<const float>(at[1]), a.probs = pointer<const float>(at[2]);
            a.out_means = pointer<float>(at[4]), a.out_quats = pointer<float>(at[5]);
            nb::gil_scoped_release release;
            blend_forward(a, pointer<const float>(at[3]), threads);
        },
        "addresses (means [n, 3], quats [n, 4], probs [parts, n], twists [parts - 1, 6], moved means, moved quats), n, parts, threads");
    m.def(
        "blend_backward",
        [](const std::array<Address, 10>& at, int64_t n, int parts, int threads) {
            BlendArgs a = {};
            a.n = n, a.parts = parts;
            a.means = pointer<const float>(at[0]), a.quats = pointer<const float>(at[1]), a.probs = pointer<const float>(at[2]);
            a.grad_means = pointer<const float>(at[4]), a.grad_quats = pointer<const float>(at[5]);
            a.v_means = pointer<float>(at[6]), a.v_quats = pointer<float>(at[7]), a.v_probs = pointer<float>(at[8]);
            nb::gil_scoped_release release;
            blend_backward(a, pointer<const float>(at[3]), pointer<float>(at[9]), threads);
        },
        "addresses (means, quats, probs, twists as in forward; gradients by the moved means and quats, 0 = none; gradients to means, quats, "
        "probs, twists), n, parts, threads");
    m.def(
        "part_motions",
        [](Address twists, Address out, int parts) { part_motions(parts, pointer<const float>(twists), pointer<float>(out)); },
        "twists [parts - 1, 6] to motions [parts, 4, 4], slot 0 the identity");
    m.def(
        "part_motions_backward",
        [](Address twists, Address grad, Address v_twists, int parts) {
            part_motions_backward(parts, pointer<const float>(twists), pointer<const float>(grad), pointer<float>(v_twists));
        },
        "gradient [parts, 4, 4] by the motions to the twists' [parts - 1, 6]");
}

}  // namespace p2gs
