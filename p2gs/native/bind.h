// One bind function per family of kernels, each defined in bind_<family>.cpp.
#pragma once

#include <nanobind/nanobind.h>

#include <cstdint>

namespace nb = nanobind;

namespace p2gs {

using Address = std::uintptr_t;  // what tensor.data_ptr() returns; 0 = none
using WithoutGil = nb::call_guard<nb::gil_scoped_release>;

template <class T>
T* pointer(Address a) {
    return reinterpret_cast<T*>(a);
}

void bind_adam(nb::module_& m);
void bind_blend(nb::module_& m);
void bind_carry(nb::module_& m);
void bind_image(nb::module_& m);
void bind_planar(nb::module_& m);
void bind_planes(nb::module_& m);
void bind_ssim(nb::module_& m);
void bind_knn(nb::module_& m);
void bind_evidence(nb::module_& m);
void bind_motions(nb::module_& m);
void bind_fuse(nb::module_& m);
void bind_graph(nb::module_& m);
void bind_views(nb::module_& m);
void bind_landing(nb::module_& m);
void bind_pull(nb::module_& m);
void bind_raster(nb::module_& m);
void bind_repel(nb::module_& m);
void bind_assign(nb::module_& m);
void bind_cut(nb::module_& m);
void bind_steps(nb::module_& m);
void bind_sweep(nb::module_& m);

}  // namespace p2gs
