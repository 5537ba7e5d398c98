#include "bind.h"
#include "ssim.h"

namespace p2gs {

void bind_ssim(nb::module_& m) {
    m.def("ssim_padded", &ssim_padded, "Row length of a statistics plane for rows of n floats.");
    m.def(
        "l1_ssim",
        [](Address pred, int64_t pred_stride, Address target, int64_t target_stride, int height, int width, float lam, Address stats,
           bool have_target, Address grad, int64_t grad_stride, int threads) {
            SsimArgs args{};
            args.pred = pointer<const float>(pred);
            args.target = pointer<const float>(target);
            args.grad = pointer<float>(grad);
            args.pred_stride = pred_stride;
            args.target_stride = target_stride;
            args.grad_stride = grad_stride;
            args.rows = height;
            args.n = 3 * width;
            args.padded = ssim_padded(args.n);
            args.target_mean = pointer<float>(stats);
            args.target_sq = args.target_mean + int64_t(height) * args.padded;
            return l1_ssim(args, lam, have_target, threads);
        },
        WithoutGil(),
        "The loss of an image pair [height, width, 3] (addresses, floats between rows); grad (0 = none) receives its gradient. "
        "stats: [2, height, ssim_padded(3 width)], filled unless have_target.");
}

}  // namespace p2gs
