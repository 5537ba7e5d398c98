// Motions as the bindings that take some get them.
#pragma once

#include <nanobind/stl/array.h>

#include <array>

#include "bind.h"
#include "motions.h"

namespace p2gs {

using Motions = std::array<Address, 4>;  // turn, axis, centre, amount of a MotionBatch

inline MotionBatch batch(const Motions& at, int64_t count) {
    return {pointer<const uint8_t>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]), pointer<const float>(at[3]), count};
}

}  // namespace p2gs
