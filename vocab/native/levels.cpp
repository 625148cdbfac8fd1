#include "kernels.hpp"

namespace seamark {

const Kernels* const* available_levels() {
    static const Kernels* levels[4] = {nullptr, nullptr, nullptr, nullptr};
    static const bool found = [] {
        int n = 0;
        levels[n++] = &kBaseline;
#if defined(SEAMARK_X86_LEVELS)
        __builtin_cpu_init();
        if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt")) levels[n++] = &kAvx2;
        if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
            __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512vnni") &&
            __builtin_cpu_supports("avx512vpopcntdq"))
            levels[n++] = &kAvx512;
#endif
        return true;
    }();
    (void)found;
    return levels;
}

}  // namespace seamark
