// Python module p2gs._native. Tensors arrive as addresses (tensor.data_ptr()): the callers in p2gs/ops, p2gs/render and p2gs/models
// check shape, dtype and contiguity; nothing here does.
#include "bind.h"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdlib>
#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include <atomic>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels.h"
#include "pool.h"

NB_MODULE(_native, m) {
    using namespace p2gs;
    m.def("isa", [] { return std::string(kernels().isa); }, "Instruction set in use: 'avx512', 'avx2' or 'portable'.");
    m.def(
        "set_isa",
        [](const std::string& name) {
            if (!set_isa(name.c_str())) throw nb::value_error(("this machine does not run kernels for '" + name + "'").c_str());
        },
        "Use the kernels of another instruction set. Raises ValueError where this machine does not run it.");
    m.def(
        "available_isas",
        [] {
            std::vector<std::string> names;
            for (const char* const* n = available_isas(); *n; ++n) names.emplace_back(*n);
            return names;
        },
        "Instruction sets this machine runs, best first.");
    m.def(
        "keep_memory",
        [] {
#if defined(__GLIBC__)
            mallopt(M_MMAP_THRESHOLD, 32 << 20);  // the largest value glibc takes
            mallopt(M_TRIM_THRESHOLD, 1 << 30);
#endif
        },
        "Have malloc keep freed memory for the next step instead of giving it back to the system and faulting it in again.");
    m.def("pool_size", &pool_size, "Helper threads of the pool alive in this process.");
    m.def(
        "pool_test",
        [](int chunks, int threads, int work) {
            struct Context {
                std::vector<std::atomic<int>> hits;
                std::atomic<long> total{0};
                int work, threads;
            } c{std::vector<std::atomic<int>>(chunks), {}, work, threads};
            nb::gil_scoped_release release;
            parallel_for(
                chunks, threads,
                [](int chunk, int thread, void* p) {
                    Context& c = *static_cast<Context*>(p);
                    unsigned x = chunk + 1;
                    for (int i = 0; i < c.work; ++i) x = x * 1664525u + 1013904223u;
                    if (thread < 0 || thread >= c.threads || (c.work && x == 0)) c.total += 1000000;
                    c.hits[chunk]++;
                    c.total++;
                },
                &c);
            for (auto& h : c.hits)
                if (h != 1) return -1L;
            return c.total.load();
        },
        "Run `chunks` counting chunks of `work` steps; the number done, -1 where one was not done exactly once (for tests).");
    bind_adam(m);
    bind_blend(m);
    bind_carry(m);
    bind_image(m);
    bind_planar(m);
    bind_planes(m);
    bind_ssim(m);
    bind_pull(m);
    bind_raster(m);
    bind_knn(m);
    bind_landing(m);
    bind_fuse(m);
    bind_graph(m);
    bind_evidence(m);
    bind_motions(m);
    bind_views(m);
    bind_assign(m);
    bind_repel(m);
    bind_cut(m);
    bind_steps(m);
    bind_sweep(m);
}
