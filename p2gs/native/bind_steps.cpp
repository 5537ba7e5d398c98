#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "steps.h"

namespace p2gs {

void bind_steps(nb::module_& m) {
    m.def(
        "motion_steps",
        [](const std::array<Address, 10>& at, int parts, double rate, Address out) {
            motion_steps({pointer<const double>(at[0]), pointer<const double>(at[1]), pointer<const double>(at[2]), pointer<const double>(at[3]),
                          pointer<const double>(at[4]), pointer<const double>(at[5]), pointer<const uint8_t>(at[6]), pointer<const uint8_t>(at[7]),
                          pointer<double>(at[8]), pointer<double>(at[9]), parts, rate},
                         pointer<double>(out));
        },
        "out float64 [parts, 4, 4]. addresses: transforms [parts, 4, 4], gradient [parts, 6], centre [parts, 3], radius [parts], axes [parts, 3] "
        "(0 = none is held), fades [2, parts], kinds (0 free, 1 turn, 2 slide) and on uint8 [parts], and what changes: first, second [parts, 6].");
}

}  // namespace p2gs
