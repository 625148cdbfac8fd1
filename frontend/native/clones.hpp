// A function marked SEAMARK_CLONES is compiled for several levels of the processor; the loader takes the best one.
//
// Every level gives the same bits: sums run in lanes whose order is written down, and nothing is contracted into fused
// operations (-ffp-contract=off).
#pragma once

#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define SEAMARK_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define SEAMARK_CLONES
#endif
#define SEAMARK_INLINE inline __attribute__((always_inline))
