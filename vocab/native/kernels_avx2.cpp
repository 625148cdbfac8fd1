// AVX2: sixteen 16-bit products at a time.
#include <immintrin.h>

#include "kernels.hpp"

namespace seamark {
namespace {

constexpr int kChunks = kDescriptorSize / 4;

struct Shifted {
    // Dimensions 0 and 2 of each chunk of four, then 1 and 3, less 128, as pairs of 16 bits.
    alignas(32) int32_t even[kChunks];
    alignas(32) int32_t odd[kChunks];
};

int32_t pair(int low, int high) { return static_cast<int32_t>((static_cast<uint32_t>(high) << 16) | (low & 0xffff)); }

template <int N>
void tile(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const Shifted* shifted, int32_t* out,
          int64_t stride) {
    const __m256i low_bytes = _mm256_set1_epi16(0x00ff);
    for (int64_t g = 0; g < n_groups; ++g) {
        __m256i dot[N][2];
        for (int i = 0; i < N; ++i) dot[i][0] = dot[i][1] = _mm256_setzero_si256();
        const __m256i* words = reinterpret_cast<const __m256i*>(groups + g * kGroupBytes);
        for (int c = 0; c < kChunks; ++c) {
            for (int half = 0; half < 2; ++half) {
                const __m256i bytes = _mm256_load_si256(words + 2 * c + half);
                const __m256i even = _mm256_and_si256(bytes, low_bytes), odd = _mm256_srli_epi16(bytes, 8);
                for (int i = 0; i < N; ++i) {
                    const __m256i a = _mm256_madd_epi16(even, _mm256_set1_epi32(shifted[i].even[c]));
                    const __m256i b = _mm256_madd_epi16(odd, _mm256_set1_epi32(shifted[i].odd[c]));
                    dot[i][half] = _mm256_add_epi32(dot[i][half], _mm256_add_epi32(a, b));
                }
            }
        }
        for (int half = 0; half < 2; ++half) {
            const int64_t at = g * kGroup + 8 * half;
            const __m256i start = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(bias + at));
            for (int i = 0; i < N; ++i) {
                const __m256i value = _mm256_sub_epi32(start, _mm256_slli_epi32(dot[i][half], 1));
                _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + i * stride + at), value);
            }
        }
    }
}

void distances(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors, int n,
               int32_t* out, int64_t stride) {
    Shifted shifted[kTile];
    for (int i = 0; i < n; ++i)
        for (int c = 0; c < kChunks; ++c) {
            const uint8_t* d = descriptors[i] + 4 * c;
            shifted[i].even[c] = pair(d[0] - 128, d[2] - 128);
            shifted[i].odd[c] = pair(d[1] - 128, d[3] - 128);
        }
    switch (n) {
        case 1: return tile<1>(groups, bias, n_groups, shifted, out, stride);
        case 2: return tile<2>(groups, bias, n_groups, shifted, out, stride);
        case 3: return tile<3>(groups, bias, n_groups, shifted, out, stride);
        default: return tile<4>(groups, bias, n_groups, shifted, out, stride);
    }
}

int64_t smallest(const int32_t* values, int64_t n) {
    int32_t least = values[0];
    for (int64_t i = 1; i < n; ++i) least = values[i] < least ? values[i] : least;  // vectorised by the compiler
    int64_t at = 0;
    while (values[at] != least) ++at;
    return at;
}

void nearest(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors, int n,
             int32_t* value, int32_t* at) {
    nearest_by(distances, smallest, groups, bias, n_groups, descriptors, n, value, at);
}

int64_t at_most(const int32_t* values, int64_t n, int32_t limit, int32_t* positions) {
    int64_t found = 0;
    for (int64_t i = 0; i < n; ++i) {
        positions[found] = static_cast<int32_t>(i);
        found += values[i] <= limit;
    }
    return found;
}

int64_t near_signatures(const uint64_t* signatures, int64_t n, uint64_t query, int limit, uint32_t* positions,
                        uint8_t* distances) {
    int64_t found = 0;
    for (int64_t i = 0; i < n; ++i) {
        const int distance = static_cast<int>(_mm_popcnt_u64(signatures[i] ^ query));
        positions[found] = static_cast<uint32_t>(i);
        distances[found] = static_cast<uint8_t>(distance);
        found += distance <= limit;
    }
    return found;
}

}  // namespace

const Kernels kAvx2 = {"avx2", distances, nearest, smallest, at_most, near_signatures};

}  // namespace seamark
