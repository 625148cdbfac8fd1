#include "pyramid.hpp"

#include <algorithm>
#include <cstring>

#include "clones.hpp"

namespace seamark {
namespace {

SEAMARK_INLINE int mirrored(int i, int n) { return i < 0 ? -i : i >= n ? 2 * n - 2 - i : i; }

// `column` has room for two more values at each end.
SEAMARK_CLONES void reduce(const Level& from, uint8_t* to, int64_t to_stride, int width, int height,
                           uint16_t* column) {
    column += 2;
    for (int y = 0; y < height; ++y) {
        const uint8_t* rows[5];
        for (int k = 0; k < 5; ++k) rows[k] = from.pixels + from.stride * mirrored(2 * y + k - 2, from.height);
        for (int x = 0; x < from.width; ++x)
            column[x] = static_cast<uint16_t>(rows[0][x] + rows[4][x] + 4 * (rows[1][x] + rows[3][x]) + 6 * rows[2][x]);
        column[-2] = column[2], column[-1] = column[1];
        column[from.width] = column[from.width - 2], column[from.width + 1] = column[from.width - 3];
        uint8_t* out = to + to_stride * y;
        for (int x = 0; x < width; ++x) {
            const uint16_t* at = column + 2 * x;
            const int sum = at[-2] + at[2] + 4 * (at[-1] + at[1]) + 6 * at[0];
            out[x] = static_cast<uint8_t>((sum + 128) >> 8);
        }
    }
}

}  // namespace

uint8_t* Pyramid::add(int width, int height) {
    const int64_t stride = (width + 2 * kRoom + 63) / 64 * 64;
    memory_.emplace_back(stride * (height + 2 * kRoom));
    uint8_t* pixels = memory_.back().data() + kRoom * stride + kRoom;
    levels_.push_back({pixels, stride, width, height});
    return pixels;
}

Pyramid::Pyramid(const uint8_t* grey, int width, int height, int n_levels) {
    uint8_t* base = add(width, height);
    for (int y = 0; y < height; ++y) std::memcpy(base + levels_[0].stride * y, grey + static_cast<int64_t>(width) * y, width);
    std::vector<uint16_t> column(width + 4);
    for (int level = 0; level < n_levels; ++level) {
        const Level from = levels_.back();
        const int half_width = (from.width + 1) / 2, half_height = (from.height + 1) / 2;
        if (std::min(half_width, half_height) < kLeast) break;
        uint8_t* pixels = add(half_width, half_height);
        reduce(from, pixels, levels_.back().stride, half_width, half_height, column.data());
    }
}

}  // namespace seamark
