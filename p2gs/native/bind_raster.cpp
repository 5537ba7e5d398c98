#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <memory>
#include <mutex>
#include <vector>

#include "bind.h"
#include "kernels.h"
#include "raster_frame.h"

namespace p2gs {
namespace {

// Frames not in use, for the next view. Never destroyed: the interpreter may still hold a RasterView at exit.
struct FramePool {
    std::mutex mutex;
    std::vector<std::unique_ptr<Frame>> idle;
};

FramePool& frame_pool() {
    static FramePool* pool = new FramePool;
    return *pool;
}

constexpr size_t kKeepIdle = 4;

// One rendered view: the arguments it was rendered with and the memory its backward pass needs.
class RasterView {
public:
    RasterView() {
        FramePool& pool = frame_pool();
        std::lock_guard<std::mutex> lock(pool.mutex);
        if (!pool.idle.empty()) {
            frame_ = std::move(pool.idle.back());
            pool.idle.pop_back();
        } else {
            frame_ = std::make_unique<Frame>();
        }
    }
    ~RasterView() {
        FramePool& pool = frame_pool();
        std::lock_guard<std::mutex> lock(pool.mutex);
        if (frame_ && pool.idle.size() < kKeepIdle) pool.idle.push_back(std::move(frame_));
    }

    // addresses: means, quats, scales, opacities, sh, features, background | colour, alpha, depth, depth_sq, median, features, radii | sh_rest
    void forward(const std::array<Address, 15>& at, int64_t n, int sh_bases, int sh_degree, int num_features,
                 const std::array<float, 16>& view, const std::array<float, 4>& camera, int width, int height, float near_plane,
                 float eps2d, float depth_ref, bool antialias, bool background_image, bool stored, bool keep, int threads) {
        RasterArgs& a = args_;
        a = {};
        a.n = n;
        a.means = pointer<const float>(at[0]);
        a.quats = pointer<const float>(at[1]);
        a.scales = pointer<const float>(at[2]);
        a.opacities = pointer<const float>(at[3]);
        a.sh = pointer<const float>(at[4]);
        a.features = pointer<const float>(at[5]);
        a.background = pointer<const float>(at[6]);
        a.colour = pointer<float>(at[7]);
        a.alpha = pointer<float>(at[8]);
        a.depth = pointer<float>(at[9]);
        a.depth_sq = pointer<float>(at[10]);
        a.median = pointer<float>(at[11]);
        a.features_out = pointer<float>(at[12]);
        a.radii = pointer<int32_t>(at[13]);
        a.sh_rest = pointer<const float>(at[14]);
        a.stored = stored;
        a.sh_bases = sh_bases;
        a.sh_degree = sh_degree;
        a.num_features = num_features;
        for (int i = 0; i < 12; ++i) a.view[i] = view[i];
        a.fx = camera[0], a.fy = camera[1], a.cx = camera[2], a.cy = camera[3];
        a.width = width;
        a.height = height;
        a.near_plane = near_plane;
        a.eps2d = eps2d;
        a.depth_ref = depth_ref;
        a.antialias = antialias;
        a.background_image = background_image;
        nb::gil_scoped_release release;
        frame_->forward(a, keep, threads < 1 ? 1 : threads);
    }

    // gradients of colour, alpha, depth, depth_sq, features | to means, quats, scales, opacities, sh, features, abs_grad, sh_rest, view
    void backward(const std::array<Address, 14>& at, int threads) {
        RasterGrads g = {};
        g.colour = pointer<const float>(at[0]);
        g.alpha = pointer<const float>(at[1]);
        g.depth = pointer<const float>(at[2]);
        g.depth_sq = pointer<const float>(at[3]);
        g.features = pointer<const float>(at[4]);
        g.means = pointer<float>(at[5]);
        g.quats = pointer<float>(at[6]);
        g.scales = pointer<float>(at[7]);
        g.opacities = pointer<float>(at[8]);
        g.sh = pointer<float>(at[9]);
        g.v_features = pointer<float>(at[10]);
        g.abs_grad = pointer<float>(at[11]);
        g.sh_rest = pointer<float>(at[12]);
        g.view = pointer<float>(at[13]);
        nb::gil_scoped_release release;
        frame_->backward(args_, g, threads < 1 ? 1 : threads);
    }

private:
    std::unique_ptr<Frame> frame_;
    RasterArgs args_ = {};
};

}  // namespace

void bind_raster(nb::module_& m) {
    nb::set_leak_warnings(false);  // a graph that is alive when the interpreter ends holds a view: no leak worth a message
    nb::class_<RasterView>(m, "RasterView", "One view: forward once, then backward any number of times; the caller keeps the tensors alive.")
        .def(nb::init<>())
        .def("forward", &RasterView::forward,
             "addresses (means, quats, scales, opacities, sh, features, background, colour, alpha, depth, depth_sq, median, features out, "
             "radii, sh_rest; 0 = none), n, sh_bases, sh_degree, num_features, viewmat (16 floats), (fx, fy, cx, cy), width, height, near, eps2d, "
             "depth_ref, antialias, background is an image, stored (scales are logarithms, opacities logits), backward will follow, threads. "
             "With sh_rest, sh is the constant band alone.")
        .def("backward", &RasterView::backward,
             "addresses (gradients by colour, alpha, depth, depth_sq, features; gradients to means, quats, scales, opacities, sh, features, "
             "abs_grad, sh_rest, rows of viewmat [3, 4]; 0 = none), threads");
}

}  // namespace p2gs
