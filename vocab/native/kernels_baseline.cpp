// Plain loops for any processor.
#include "kernels.hpp"

namespace seamark {
namespace {

void distances(const uint8_t* groups, const int32_t* bias, int64_t n_groups, const uint8_t* const* descriptors, int n,
               int32_t* out, int64_t stride) {
    for (int i = 0; i < n; ++i) {
        int16_t shifted[kDescriptorSize];
        for (int j = 0; j < kDescriptorSize; ++j) shifted[j] = static_cast<int16_t>(descriptors[i][j] - 128);
        for (int64_t g = 0; g < n_groups; ++g) {
            int32_t dot[kGroup] = {};
            const uint8_t* words = groups + g * kGroupBytes;
            for (int c = 0; c < kDescriptorSize / 4; ++c, words += 4 * kGroup)
                for (int w = 0; w < kGroup; ++w)
                    for (int j = 0; j < 4; ++j) dot[w] += words[4 * w + j] * shifted[4 * c + j];
            for (int w = 0; w < kGroup; ++w) out[i * stride + g * kGroup + w] = bias[g * kGroup + w] - 2 * dot[w];
        }
    }
}

int64_t smallest(const int32_t* values, int64_t n) {
    int32_t least = values[0];
    for (int64_t i = 1; i < n; ++i) least = values[i] < least ? values[i] : least;
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
        uint64_t x = signatures[i] ^ query;
        x -= (x >> 1) & 0x5555555555555555u;
        x = (x & 0x3333333333333333u) + ((x >> 2) & 0x3333333333333333u);
        x = (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0fu;
        const int distance = static_cast<int>((x * 0x0101010101010101u) >> 56);
        positions[found] = static_cast<uint32_t>(i);
        distances[found] = static_cast<uint8_t>(distance);
        found += distance <= limit;
    }
    return found;
}

}  // namespace

const Kernels kBaseline = {"baseline", distances, nearest, smallest, at_most, near_signatures};

}  // namespace seamark
