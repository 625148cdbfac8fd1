// The loops that deserve a processor's own instructions, once for each level; which level runs is decided at run time.
//
// Only integers are computed here, so that every level gives the same bits. The files of the levels must not include
// headers of the C++ library: an inline function compiled with wide instructions could be linked into everything.
#pragma once

#include <stdint.h>

namespace seamark {

constexpr int kDescriptorSize = 128;
constexpr int kGroup = 16;                                   // words per group
constexpr int kGroupBytes = kGroup * kDescriptorSize;        // four dimensions of sixteen words, then the next four
constexpr int kMostGroups = 16;  // of one call: 32 KiB of words, a first-level cache
constexpr int kTile = 4;                                     // descriptors that are compared at a time

struct Kernels {
    const char* name;

    // Compares descriptors (n of 128 bytes, n <= kTile) with the words of n_groups groups: out[i * stride + word] is the
    // squared distance less the descriptor's own square, bias - 2 sum w (d - 128), with bias = sum w^2 - 256 sum w.
    void (*distances)(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors,
                      int n, int32_t* out, int64_t stride);

    // Finds for each of n <= kTile descriptors the word of n_groups groups (at most kMostGroups) that is nearest, the
    // first of equally near ones: at[i] counts words, value[i] is what `distances` gives for it.
    void (*nearest)(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors,
                    int n, int32_t* value, int32_t* at);

    // Returns the position of the smallest of n > 0 values, the first of equal ones.
    int64_t (*smallest)(const int32_t* values, int64_t n);

    // Writes the positions (ascending) of the values at most `limit` and returns how many there are; room for n and 16 more.
    int64_t (*at_most)(const int32_t* values, int64_t n, int32_t limit, int32_t* positions);

    // Writes the positions (ascending) and Hamming distances of the signatures at most `limit` from the query's and
    // returns how many there are. Both outputs have room for n rounded up to 8.
    int64_t (*near_signatures)(const uint64_t* signatures, int64_t n, uint64_t query, int limit, uint32_t* positions,
                               uint8_t* distances);
};

// What `nearest` does, by way of `distances` and `smallest`, for levels without a faster one.
template <class Distances, class Smallest>
static void nearest_by(Distances distances, Smallest smallest, const uint8_t* groups, const int32_t* bias,
                       int64_t n_groups, const uint8_t* const* descriptors, int n, int32_t* value, int32_t* at) {
    constexpr int64_t kWidth = kMostGroups * kGroup;
    int32_t all[kTile * kWidth];
    distances(groups, bias, n_groups, descriptors, n, all, kWidth);
    for (int i = 0; i < n; ++i) {
        at[i] = static_cast<int32_t>(smallest(all + i * kWidth, n_groups * kGroup));
        value[i] = all[i * kWidth + at[i]];
    }
}

extern const Kernels kBaseline;
#if defined(SEAMARK_X86_LEVELS)
extern const Kernels kAvx2;
extern const Kernels kAvx512;
#endif

// The levels this processor has, from the slowest to the fastest, as a list that ends with nullptr.
const Kernels* const* available_levels();

}  // namespace seamark
