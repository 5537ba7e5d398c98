#include "bind.h"

#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tuple>
#include <vector>

#include "adam.h"

namespace p2gs {

void bind_adam(nb::module_& m) {
    using Item = std::tuple<Address, Address, Address, Address, int64_t, float, double, double, float, float>;
    m.def(
        "adam_step",
        [](const std::vector<Item>& items, int threads) {
            std::vector<AdamTensor> tensors;
            for (const auto& [p, g, m1, v, size, step_size, beta1, beta2, eps, bias2_sqrt] : items)
                tensors.push_back({pointer<float>(p), pointer<const float>(g), pointer<float>(m1), pointer<float>(v), size, step_size,
                                   float(1 - beta1), float(beta2), float(1 - beta2), eps, bias2_sqrt});
            nb::gil_scoped_release release;
            adam_step(tensors.data(), int(tensors.size()), threads);
        },
        "One Adam step over tuples (param, grad, exp_avg, exp_avg_sq: addresses; size, lr / (1 - beta1^t), beta1, beta2, eps, "
        "sqrt(1 - beta2^t)).");
}

}  // namespace p2gs
