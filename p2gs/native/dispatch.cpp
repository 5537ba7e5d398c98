#include <atomic>
#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace p2gs {
namespace {

const Kernels* const* supported() {
    static const Kernels* list[4] = {};
    static const bool filled = [] {
        int n = 0;
#ifdef P2GS_X86
        __builtin_cpu_init();
        bool avx2_ok = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                       __builtin_cpu_supports("bmi2");
        if (avx2_ok && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
            __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
            list[n++] = &avx512::table;
        if (avx2_ok) list[n++] = &avx2::table;
#endif
        list[n++] = &portable::table;
        return true;
    }();
    (void)filled;
    return list;
}

const Kernels* find(const char* name) {
    for (const Kernels* const* k = supported(); *k; ++k)
        if (!std::strcmp((*k)->isa, name)) return *k;
    return nullptr;
}

std::atomic<const Kernels*> g_current{nullptr};

}  // namespace

const Kernels& kernels() {
    const Kernels* k = g_current.load(std::memory_order_relaxed);
    if (!k) {
        const char* wanted = std::getenv("P2GS_ISA");
        if (wanted) k = find(wanted);
        if (!k) k = supported()[0];
        g_current.store(k, std::memory_order_relaxed);
    }
    return *k;
}

bool set_isa(const char* name) {
    const Kernels* k = find(name);
    if (k) g_current.store(k, std::memory_order_relaxed);
    return k != nullptr;
}

const char* const* available_isas() {
    static const char* names[4] = {};
    const Kernels* const* k = supported();
    for (int i = 0; k[i]; ++i) names[i] = k[i]->isa;
    return names;
}

}  // namespace p2gs
