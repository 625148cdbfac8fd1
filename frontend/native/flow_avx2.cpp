// AVX2: a row is two registers of sixteen numbers.
#include <immintrin.h>

#include "flow_loops.hpp"

namespace seamark {
namespace {

struct Avx2Row {
    __m256i low, high;

    struct Sum {
        __m256i sum = _mm256_setzero_si256();
        __m256i other = _mm256_setzero_si256();
        void add(const Avx2Row& a, const Avx2Row& b) {
            sum = _mm256_add_epi32(sum, _mm256_madd_epi16(a.low, b.low));
            other = _mm256_add_epi32(other, _mm256_madd_epi16(a.high, b.high));
        }
        static __m256i widened(__m256i half) {
            return _mm256_add_epi64(_mm256_cvtepi32_epi64(_mm256_castsi256_si128(half)),
                                    _mm256_cvtepi32_epi64(_mm256_extracti128_si256(half, 1)));
        }
        int64_t total() const {
            const __m256i wide = _mm256_add_epi64(widened(sum), widened(other));
            const __m128i pair = _mm_add_epi64(_mm256_castsi256_si128(wide), _mm256_extracti128_si256(wide, 1));
            return _mm_extract_epi64(pair, 0) + _mm_extract_epi64(pair, 1);
        }
    };

    static Avx2Row all(int value) {
        const __m256i lanes = _mm256_set1_epi16(static_cast<short>(value));
        return {lanes, lanes};
    }
    static __m256i grey(const uint8_t* pixels) {
        const __m256i bytes = _mm256_cvtepu8_epi16(_mm_loadu_si128(reinterpret_cast<const __m128i*>(pixels)));
        return _mm256_slli_epi16(_mm256_sub_epi16(bytes, _mm256_set1_epi16(128)), 5);
    }
    static Avx2Row of_pixels(const uint8_t* pixels) { return {grey(pixels), grey(pixels + 16)}; }
    static Avx2Row load(const int16_t* from) {
        const auto* at = reinterpret_cast<const __m256i*>(from);
        return {_mm256_loadu_si256(at), _mm256_loadu_si256(at + 1)};
    }
    void store(int16_t* to) const {
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), low);
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(to) + 1, high);
    }
    Avx2Row operator+(const Avx2Row& b) const { return {_mm256_add_epi16(low, b.low), _mm256_add_epi16(high, b.high)}; }
    Avx2Row operator-(const Avx2Row& b) const { return {_mm256_sub_epi16(low, b.low), _mm256_sub_epi16(high, b.high)}; }
    Avx2Row operator&(const Avx2Row& b) const { return {_mm256_and_si256(low, b.low), _mm256_and_si256(high, b.high)}; }
    Avx2Row times(const Avx2Row& fraction) const {
        return {_mm256_mulhrs_epi16(low, fraction.low), _mm256_mulhrs_epi16(high, fraction.high)};
    }
};

}  // namespace

const FlowKernels kFlowAvx2 = flow_kernels_of<Avx2Row>("avx2");

}  // namespace seamark
