#include "matching.hpp"

#include <cmath>
#include <limits>

#include "quantiser.hpp"

namespace seamark {
namespace {

constexpr int32_t kFar = std::numeric_limits<int32_t>::max();

// Lowers the least value of each column where the row's is lower, and says so.
void lower(const int32_t* values, int32_t offset, int32_t row, int64_t m, int32_t* least, int32_t* from) {
    for (int64_t j = 0; j < m; ++j) {
        const int32_t value = values[j] + offset;
        from[j] = value < least[j] ? row : from[j];
        least[j] = value < least[j] ? value : least[j];
    }
}

struct Similarity {
    float real, imaginary;
};

// Counts, and marks if asked to, the matches that agree with match i.
template <bool kMark>
int32_t agree(const Matches& all, int64_t i, Similarity s, float tolerance, float scale_step, uint8_t* marks) {
    const float x = all.x[i], y = all.y[i], to_x = all.to_x[i], to_y = all.to_y[i], scale = all.log_scale[i];
    const float most = tolerance * tolerance;
    int32_t count = 0;
    for (int64_t j = 0; j < all.m; ++j) {
        const float dx = all.x[j] - x, dy = all.y[j] - y;
        const float ex = to_x + s.real * dx - s.imaginary * dy - all.to_x[j];
        const float ey = to_y + s.imaginary * dx + s.real * dy - all.to_y[j];
        const bool near = (ex * ex + ey * ey < most) & (std::fabs(all.log_scale[j] - scale) < scale_step);
        if (kMark) marks[j] = near;
        count += near;
    }
    return count;
}

}  // namespace

std::vector<Pair> mutual_nearest(const uint8_t* rows, int64_t n, const uint8_t* columns, int64_t m,
                                 const Kernels& kernels) {
    Grouped grouped;
    grouped.append(columns, m);
    const int64_t stride = grouped.n_groups() * kGroup;
    std::vector<int32_t> scratch(static_cast<size_t>(kTile * stride)), least(static_cast<size_t>(m), kFar),
        from(static_cast<size_t>(m), -1);
    std::vector<Pair> nearest;
    nearest.reserve(static_cast<size_t>(n));
    for (int64_t first = 0; first < n; first += kTile) {
        const int count = static_cast<int>(n - first < kTile ? n - first : kTile);
        const uint8_t* tile[kTile];
        for (int i = 0; i < count; ++i) tile[i] = rows + (first + i) * kDescriptorSize;
        kernels.distances(grouped.bytes(0), grouped.bias(0), grouped.n_groups(), tile, count, scratch.data(), stride);
        for (int i = 0; i < count; ++i) {
            int32_t* values = scratch.data() + i * stride;
            const int32_t own = square(tile[i]);
            const auto row = static_cast<int32_t>(first + i);
            lower(values, own, row, m, least.data(), from.data());
            const int64_t at = kernels.smallest(values, m);
            const int32_t best = values[at];
            values[at] = kFar;
            const int32_t next = values[kernels.smallest(values, m)];
            nearest.push_back({row, static_cast<int32_t>(at), best + own, next + own});
        }
    }
    std::vector<Pair> mutual;
    for (const Pair& pair : nearest)
        if (from[static_cast<size_t>(pair.column)] == pair.row) mutual.push_back(pair);
    return mutual;
}

std::vector<uint8_t> best_similarity(const Matches& matches, float tolerance, float scale_step, float most_turn) {
    std::vector<uint8_t> marks(static_cast<size_t>(matches.m), 0);
    const auto similarity = [&](int64_t i) {
        const float scale = std::exp(matches.log_scale[i]);
        return Similarity{scale * std::cos(matches.turn[i]), scale * std::sin(matches.turn[i])};
    };
    int32_t most = 0;
    int64_t best = -1;
    for (int64_t i = 0; i < matches.m; ++i) {
        if (!(std::fabs(matches.turn[i]) < most_turn)) continue;
        const int32_t count = agree<false>(matches, i, similarity(i), tolerance, scale_step, nullptr);
        if (count > most) {
            most = count;
            best = i;
        }
    }
    if (best >= 0) agree<true>(matches, best, similarity(best), tolerance, scale_step, marks.data());
    return marks;
}

}  // namespace seamark
