#include <nanobind/stl/array.h>

#include <array>

#include "assign.h"
#include "bind.h"

namespace p2gs {

void bind_assign(nb::module_& m) {
    m.attr("assign_parts") = kAssignParts;
    m.attr("assign_dim") = kAssignDim;
    m.def(
        "assign_forward",
        [](const std::array<Address, 4>& at, int64_t n, int dim, int parts, float sharpness, int threads) {
            AssignArgs a = {};
            a.n = n, a.dim = dim, a.parts = parts, a.sharpness = sharpness;
            a.psi = pointer<const float>(at[0]), a.weight = pointer<const float>(at[1]), a.bias = pointer<const float>(at[2]);
            a.probs = pointer<float>(at[3]);
            nb::gil_scoped_release release;
            assign_forward(a, threads);
        },
        "addresses (psi [n, dim], weight [parts, dim], bias [parts], probabilities out [parts, n]), n, dim, parts, "
        "1 / temperature, threads");
    m.def(
        "assign_backward",
        [](const std::array<Address, 7>& at, int64_t n, int dim, int parts, float sharpness, int threads) {
            AssignArgs a = {};
            a.n = n, a.dim = dim, a.parts = parts, a.sharpness = sharpness;
            a.psi = pointer<const float>(at[0]), a.weight = pointer<const float>(at[1]), a.probs = pointer<float>(at[2]);
            a.grad = pointer<const float>(at[3]), a.v_psi = pointer<float>(at[4]);
            nb::gil_scoped_release release;
            assign_backward(a, pointer<float>(at[5]), pointer<float>(at[6]), threads);
        },
        "addresses (psi, weight, probabilities, gradient by them; gradients to psi, weight, bias), n, dim, parts, "
        "1 / temperature, threads");
}

}  // namespace p2gs
