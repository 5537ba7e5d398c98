// The planes in which Gaussians lie as a camera sees them, and where its rays meet them (p2gs/ops/planes.py).
#pragma once

#include <cstdint>

namespace p2gs {

// means, log_scales [n, 3], quats [n, 4] (wxyz, of any length but zero); eye [3]; rotation [9], world -> camera.
struct Planes {
    const float *means, *quats, *log_scales;
    float eye[3], rotation[9];
};

// out [n, 4]: normal in the camera's coordinates, distance from the eye.
void plane_features(const Planes& args, int64_t n, float* out, int threads);
// Gradients by means, quats and log_scales for v_out [n, 4].
void plane_gradients(const Planes& args, int64_t n, const float* v_out, float* v_means, float* v_quats, float* v_log_scales, int threads);

// features [n, 4] accumulated, rays [n, 3], target depth [n], counted [n] (0 or 1). Pixels count where the cosine between ray and
// normal is above `least`. v_features null: the sum of log(1 + |depth - target|) and the pixels that count, else their gradients times scale.
struct PlaneError {
    const float *features, *rays, *target;
    const uint8_t* counted;
    float* v_features;
    float least, scale;
};

struct PlaneErrorSum {
    double error;
    int64_t pixels;
};

PlaneErrorSum plane_error(const PlaneError& args, int64_t n, int threads);

}  // namespace p2gs
