// AVX-512 with 16-bit lanes: a row is one register.
#include <immintrin.h>

#include "flow_loops.hpp"

namespace seamark {
namespace {

struct Avx512Row {
    __m512i lanes;

    struct Sum {
        __m512i sum = _mm512_setzero_si512();
        void add(const Avx512Row& a, const Avx512Row& b) {
            sum = _mm512_add_epi32(sum, _mm512_madd_epi16(a.lanes, b.lanes));
        }
        int64_t total() const {
            const __m512i low = _mm512_cvtepi32_epi64(_mm512_castsi512_si256(sum));
            const __m512i high = _mm512_cvtepi32_epi64(_mm512_extracti64x4_epi64(sum, 1));
            return _mm512_reduce_add_epi64(_mm512_add_epi64(low, high));
        }
    };

    static Avx512Row all(int value) { return {_mm512_set1_epi16(static_cast<short>(value))}; }
    static Avx512Row of_pixels(const uint8_t* pixels) {
        const __m512i bytes = _mm512_cvtepu8_epi16(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(pixels)));
        return {_mm512_slli_epi16(_mm512_sub_epi16(bytes, _mm512_set1_epi16(128)), 5)};
    }
    static Avx512Row load(const int16_t* from) { return {_mm512_loadu_si512(from)}; }
    void store(int16_t* to) const { _mm512_storeu_si512(to, lanes); }
    Avx512Row operator+(const Avx512Row& b) const { return {_mm512_add_epi16(lanes, b.lanes)}; }
    Avx512Row operator-(const Avx512Row& b) const { return {_mm512_sub_epi16(lanes, b.lanes)}; }
    Avx512Row operator&(const Avx512Row& b) const { return {_mm512_and_si512(lanes, b.lanes)}; }
    Avx512Row times(const Avx512Row& fraction) const { return {_mm512_mulhrs_epi16(lanes, fraction.lanes)}; }
};

}  // namespace

const FlowKernels kFlowAvx512 = flow_kernels_of<Avx512Row>("avx512");

}  // namespace seamark
