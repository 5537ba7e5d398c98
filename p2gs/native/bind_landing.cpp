#include <algorithm>
#include <array>

#include "bind_motions.h"
#include "landing.h"

namespace p2gs {
namespace {

using Tables = std::array<Address, 3>;
using Figures = std::array<float, 10>;
using Sizes = std::array<int32_t, 6>;

LandingTables tables(const Tables& at, const Figures& f, const Sizes& sizes, Address claimed) {
    LandingTables t{pointer<const int32_t>(at[0]), pointer<const float>(at[1]), pointer<const float>(at[2]), pointer<const float>(claimed),
                    {f[0], f[1], f[2]}, f[3], f[4], f[5], f[6], f[7], f[8], f[9], {}, {}};
    std::copy_n(sizes.begin(), 3, t.fine);
    std::copy_n(sizes.begin() + 3, 3, t.coarse);
    return t;
}

}  // namespace

void bind_landing(nb::module_& m) {
    m.def(
        "landing_cost",
        [](const Tables& at, const Figures& figures, const Sizes& sizes, Address claimed, const Motions& motions, Address thick, int64_t count, bool back,
           Address surfels, int64_t size, Address index, int64_t asked, Address cost, Address met, int threads) {
            nb::gil_scoped_release release;
            landing_cost(tables(at, figures, sizes, claimed), batch(motions, count), pointer<const float>(thick), back,
                         {pointer<const float>(surfels), size, pointer<const int64_t>(index), asked}, pointer<float>(cost), pointer<int64_t>(met),
                         threads);
        },
        "Landing cost float32 and surfel met int64 [count, asked] of rows index [asked] of surfels [size, 12] under motions (turn uint8, axis, "
        "centre, amount) of plates thick [count] float32, or, back, their inverses. Of the state landed in: (nearest, depth_free, surfels), "
        "(lo, h, hc, tp, spacing, hidden, on_static, two_sided), voxels of the fine and the coarse grid, claimed float32 by surfel or 0.");
    m.def(
        "landing_fit",
        [](const Tables& at, const Figures& figures, const Sizes& sizes, const Motions& motions, int64_t count, Address basis, bool back,
           Address surfels, int64_t size, Address index, Address weights, int64_t asked, float width, float reach, Address A, Address b, int threads) {
            nb::gil_scoped_release release;
            landing_fit(tables(at, figures, sizes, 0), batch(motions, count), pointer<const float>(basis),
                        {pointer<const float>(surfels), size, pointer<const int64_t>(index), asked},
                        {pointer<const float>(weights), width, reach, back}, pointer<float>(A), pointer<float>(b), threads);
        },
        "Adds the normal equations of point-to-plane residuals to A [count, 5, 5] and b [count, 5]; basis [count, 6, 5] twists by "
        "coordinate, weights [asked]; the other arguments as in landing_cost.");
}

}  // namespace p2gs
