// AVX-512 with VNNI and VPOPCNTDQ (Ice Lake, Zen 4 and later): sixty-four 8-bit products at a time.
#include <immintrin.h>

#include "kernels.hpp"

namespace seamark {
namespace {

constexpr int kChunks = kDescriptorSize / 4;

struct Shifted {
    alignas(64) int32_t chunks[kChunks];  // four dimensions each, less 128, as signed bytes
};

// sum += products of four unsigned and four signed bytes each. As an instruction and not an intrinsic, because GCC 12
// copies every sum once per step around the intrinsic, which takes a third of the time.
inline void add_products(__m512i& sum, __m512i words, __m512i chunk) {
    asm("vpdpbusd %2, %1, %0" : "+v"(sum) : "v"(words), "v"(chunk));
}

// Calls each(i, g, distances) for N descriptors and G groups.
template <int N, int G, class Each>
inline void columns(const uint8_t* groups, const int32_t* bias, const Shifted* shifted, Each each) {
    __m512i dot[N][G];
    for (int i = 0; i < N; ++i)
        for (int g = 0; g < G; ++g) dot[i][g] = _mm512_setzero_si512();
    for (int c = 0; c < kChunks; ++c) {
        __m512i words[G];
        for (int g = 0; g < G; ++g) words[g] = _mm512_load_si512(groups + g * kGroupBytes + c * 4 * kGroup);
        for (int i = 0; i < N; ++i) {
            const __m512i chunk = _mm512_set1_epi32(shifted[i].chunks[c]);
            for (int g = 0; g < G; ++g) add_products(dot[i][g], words[g], chunk);
        }
    }
    for (int g = 0; g < G; ++g) {
        const __m512i start = _mm512_loadu_si512(bias + g * kGroup);
        for (int i = 0; i < N; ++i) each(i, g, _mm512_sub_epi32(start, _mm512_slli_epi32(dot[i][g], 1)));
    }
}

// The same for all groups; one descriptor alone needs more groups at a time to keep the processor busy.
template <int N, class Each>
inline void tile(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const Shifted* shifted, Each each) {
    constexpr int kAtATime = N == 1 ? 8 : 4;
    int64_t g = 0;
    for (; g + kAtATime <= n_groups; g += kAtATime)
        columns<N, kAtATime>(groups + g * kGroupBytes, bias + g * kGroup, shifted,
                             [&](int i, int j, __m512i found) { each(i, g + j, found); });
    for (; g < n_groups; ++g)
        columns<N, 1>(groups + g * kGroupBytes, bias + g * kGroup, shifted,
                      [&](int i, int, __m512i found) { each(i, g, found); });
}

void shift(const uint8_t* const* descriptors, int n, Shifted* shifted) {
    const __m512i sign = _mm512_set1_epi8(static_cast<char>(0x80));
    for (int i = 0; i < n; ++i)
        for (int half = 0; half < 2; ++half) {
            const __m512i bytes = _mm512_loadu_si512(descriptors[i] + 64 * half);
            _mm512_store_si512(shifted[i].chunks + 16 * half, _mm512_xor_si512(bytes, sign));
        }
}

template <int N>
void write_all(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const Shifted* shifted, int32_t* out,
               int64_t stride) {
    tile<N>(groups, bias, n_groups, shifted,
            [&](int i, int64_t g, __m512i found) { _mm512_storeu_si512(out + i * stride + g * kGroup, found); });
}

void distances(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors, int n,
               int32_t* out, int64_t stride) {
    Shifted shifted[kTile];
    shift(descriptors, n, shifted);
    switch (n) {
        case 1: return write_all<1>(groups, bias, n_groups, shifted, out, stride);
        case 2: return write_all<2>(groups, bias, n_groups, shifted, out, stride);
        case 3: return write_all<3>(groups, bias, n_groups, shifted, out, stride);
        default: return write_all<4>(groups, bias, n_groups, shifted, out, stride);
    }
}

template <int N>
void keep_nearest(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const Shifted* shifted, int32_t* value,
                  int32_t* at) {
    __m512i least[N], where[N];  // in each of sixteen lanes, and in which group
    for (int i = 0; i < N; ++i) {
        least[i] = _mm512_set1_epi32(0x7fffffff);
        where[i] = _mm512_setzero_si512();
    }
    tile<N>(groups, bias, n_groups, shifted, [&](int i, int64_t g, __m512i found) {
        const __mmask16 nearer = _mm512_cmplt_epi32_mask(found, least[i]);
        where[i] = _mm512_mask_set1_epi32(where[i], nearer, static_cast<int>(g));
        least[i] = _mm512_min_epi32(least[i], found);
    });
    const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    for (int i = 0; i < N; ++i) {
        value[i] = _mm512_reduce_min_epi32(least[i]);
        const __mmask16 equal = _mm512_cmpeq_epi32_mask(least[i], _mm512_set1_epi32(value[i]));
        at[i] = _mm512_mask_reduce_min_epi32(equal, _mm512_add_epi32(_mm512_slli_epi32(where[i], 4), lane));
    }
}

void nearest(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors, int n,
             int32_t* value, int32_t* at) {
    Shifted shifted[kTile];
    shift(descriptors, n, shifted);
    switch (n) {
        case 1: return keep_nearest<1>(groups, bias, n_groups, shifted, value, at);
        case 2: return keep_nearest<2>(groups, bias, n_groups, shifted, value, at);
        case 3: return keep_nearest<3>(groups, bias, n_groups, shifted, value, at);
        default: return keep_nearest<4>(groups, bias, n_groups, shifted, value, at);
    }
}

int64_t smallest(const int32_t* values, int64_t n) {
    __m512i least = _mm512_set1_epi32(values[0]);
    for (int64_t i = 0; i < n; i += 16) {
        const __mmask16 inside = n - i >= 16 ? 0xffff : static_cast<__mmask16>((1u << (n - i)) - 1);
        least = _mm512_min_epi32(least, _mm512_mask_loadu_epi32(least, inside, values + i));
    }
    const __m512i wanted = _mm512_set1_epi32(_mm512_reduce_min_epi32(least));
    for (int64_t i = 0;; i += 16) {
        const __mmask16 inside = n - i >= 16 ? 0xffff : static_cast<__mmask16>((1u << (n - i)) - 1);
        const __mmask16 equal = _mm512_mask_cmpeq_epi32_mask(inside, _mm512_maskz_loadu_epi32(inside, values + i), wanted);
        if (equal) return i + __builtin_ctz(equal);
    }
}

int64_t at_most(const int32_t* values, int64_t n, int32_t limit, int32_t* positions) {
    const __m512i most = _mm512_set1_epi32(limit);
    __m512i position = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    int64_t found = 0;
    for (int64_t i = 0; i < n; i += 16, position = _mm512_add_epi32(position, _mm512_set1_epi32(16))) {
        const __mmask16 inside = n - i >= 16 ? 0xffff : static_cast<__mmask16>((1u << (n - i)) - 1);
        const __mmask16 near = _mm512_mask_cmple_epi32_mask(inside, _mm512_maskz_loadu_epi32(inside, values + i), most);
        if (!near) continue;
        _mm512_storeu_si512(positions + found, _mm512_maskz_compress_epi32(near, position));
        found += __builtin_popcount(near);
    }
    return found;
}

int64_t near_signatures(const uint64_t* signatures, int64_t n, uint64_t query, int limit, uint32_t* positions,
                        uint8_t* distances) {
    int64_t found = 0;
    const __m512i wanted = _mm512_set1_epi64(static_cast<long long>(query)), most = _mm512_set1_epi64(limit);
    __m256i position = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    for (int64_t i = 0; i < n; i += 8, position = _mm256_add_epi32(position, _mm256_set1_epi32(8))) {
        const __mmask8 inside = n - i >= 8 ? 0xff : static_cast<__mmask8>((1u << (n - i)) - 1);
        const __m512i differing = _mm512_xor_si512(_mm512_maskz_loadu_epi64(inside, signatures + i), wanted);
        const __m512i distance = _mm512_popcnt_epi64(differing);
        const __mmask8 near = _mm512_mask_cmple_epi64_mask(inside, distance, most);
        if (!near) continue;
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(positions + found), _mm256_maskz_compress_epi32(near, position));
        const __m128i bytes = _mm512_cvtepi64_epi8(_mm512_maskz_compress_epi64(near, distance));
        _mm_storel_epi64(reinterpret_cast<__m128i*>(distances + found), bytes);
        found += __builtin_popcount(near);
    }
    return found;
}

}  // namespace

const Kernels kAvx512 = {"avx512", distances, nearest, smallest, at_most, near_signatures};

}  // namespace seamark
