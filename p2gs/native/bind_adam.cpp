#include "bind.h"

#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <tuple>
#include <vector>

#include "adam.h"

namespace p2gs {

void bind_adam(nb::module_& m) {
    using Item = std::tuple<Address, Address, Address, Address, Address, int64_t, double, double, double, float>;
    m.def(
        "adam_step",
        [](const std::vector<Item>& items, int threads) {
            std::vector<AdamTensor> tensors;
            for (const auto& [p, g, m1, v, count, size, lr, beta1, beta2, eps] : items) {
                const double t = *pointer<float>(count) += 1;
                tensors.push_back({pointer<float>(p), pointer<const float>(g), pointer<float>(m1), pointer<float>(v), size,
                                   float(lr / (1 - std::pow(beta1, t))), float(1 - beta1), float(beta2), float(1 - beta2), eps,
                                   float(std::sqrt(1 - std::pow(beta2, t)))});
            }
            nb::gil_scoped_release release;
            adam_step(tensors.data(), int(tensors.size()), threads);
        },
        "One Adam step over tuples (param, grad, exp_avg, exp_avg_sq, step: addresses, step of one float, which is counted up; size, lr, beta1, "
        "beta2, eps).");
}

}  // namespace p2gs
