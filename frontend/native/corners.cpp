// Slopes and their sums are whole numbers, and every response is computed in the same order: the same bits everywhere.
#include "corners.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "clones.hpp"

namespace seamark {
namespace {

constexpr int kHalf = 2, kBlock = 2 * kHalf + 1;
constexpr float kScale = 1.0f / (4 * kBlock * 255);  // of a slope, as OpenCV has it

// Products of the slopes of one row, and their sums over the last five rows.
struct Rows {
    std::vector<int32_t> products[kBlock][3], sums[3];
    std::vector<float> response;

    explicit Rows(int width) : response(width) {
        for (auto& sum : sums) sum.resize(width);
        for (auto& row : products)
            for (auto& product : row) product.resize(width);
    }
};

// Replaces the oldest of the rows in the sums by row y of the image.
SEAMARK_INLINE void take(const Level& image, int y, Rows& rows) {
    const uint8_t *above = image.pixels + image.stride * (y - 1), *at = above + image.stride, *below = at + image.stride;
    int32_t* xx = rows.products[y % kBlock][0].data();
    int32_t* xy = rows.products[y % kBlock][1].data();
    int32_t* yy = rows.products[y % kBlock][2].data();
    int32_t* sum_xx = rows.sums[0].data();
    int32_t* sum_xy = rows.sums[1].data();
    int32_t* sum_yy = rows.sums[2].data();
    const int last = image.width - 1;  // known to the compiler not to change
#pragma GCC ivdep
    for (int x = 1; x < last; ++x) {
        const int32_t right = above[x + 1] + 2 * at[x + 1] + below[x + 1], left = above[x - 1] + 2 * at[x - 1] + below[x - 1];
        const int32_t lower = below[x - 1] + 2 * below[x] + below[x + 1], upper = above[x - 1] + 2 * above[x] + above[x + 1];
        const int32_t dx = right - left, dy = lower - upper;
        const int32_t new_xx = dx * dx, new_xy = dx * dy, new_yy = dy * dy;
        sum_xx[x] += new_xx - xx[x], sum_xy[x] += new_xy - xy[x], sum_yy[x] += new_yy - yy[x];
        xx[x] = new_xx, xy[x] = new_xy, yy[x] = new_yy;
    }
}

SEAMARK_INLINE void respond(Rows& rows, int first, int last, float harris_k) {
    const int32_t *sum_xx = rows.sums[0].data(), *sum_xy = rows.sums[1].data(), *sum_yy = rows.sums[2].data();
    float* out = rows.response.data();
#pragma GCC ivdep
    for (int x = first; x < last; ++x) {
        int32_t wide[3] = {};
        for (int k = -kHalf; k <= kHalf; ++k) wide[0] += sum_xx[x + k], wide[1] += sum_xy[x + k], wide[2] += sum_yy[x + k];
        const float a = static_cast<float>(wide[0]) * (kScale * kScale), b = static_cast<float>(wide[1]) * (kScale * kScale),
                    c = static_cast<float>(wide[2]) * (kScale * kScale);
        const float smaller = 0.5f * (a + c) - std::sqrt(0.25f * (a - c) * (a - c) + b * b);
        out[x] = harris_k > 0 ? a * c - b * b - harris_k * (a + c) * (a + c) : smaller;
    }
}

}  // namespace

SEAMARK_CLONES void strongest(const Level& image, const Grid& grid, float harris_k, const uint8_t* mask, float* strength,
                              int32_t* pixels) {
    const int n = grid.rows * grid.columns;
    std::fill(strength, strength + n, 0.0f);
    std::fill(pixels, pixels + 2 * n, 0);
    const int bottom = std::min(image.height - grid.border, grid.rows * grid.cell);
    const int right = std::min(image.width - grid.border, grid.columns * grid.cell);
    Rows rows(image.width);
    for (int y = grid.border - kHalf; y < bottom + kHalf; ++y) {
        take(image, y, rows);
        const int at = y - kHalf;  // the row whose five rows are there
        if (at < grid.border) continue;
        respond(rows, grid.border, right, harris_k);
        float* response = rows.response.data();
        if (mask)
            for (int x = grid.border; x < right; ++x)
                if (!mask[static_cast<int64_t>(at) * image.width + x]) response[x] = 0;
        for (int column = 0; column < grid.columns; ++column) {
            const int first = std::max(grid.border, column * grid.cell), last = std::min(right, (column + 1) * grid.cell);
            float most = 0;
            for (int x = first; x < last; ++x) most = response[x] > most ? response[x] : most;
            const int cell = at / grid.cell * grid.columns + column;
            if (!(most > strength[cell])) continue;
            strength[cell] = most;
            pixels[2 * cell] = static_cast<int32_t>(std::find(response + first, response + last, most) - response);
            pixels[2 * cell + 1] = at;
        }
    }
}

double median_difference(const Level& image) {
    std::vector<int64_t> counts(8 * 255 + 1);
    int64_t n = 0;
    for (int y = 1; y < image.height - 1; y += 3)
        for (int x = 1; x < image.width - 1; x += 3) {
            const uint8_t *at = image.pixels + image.stride * y + x, *above = at - image.stride, *below = at + image.stride;
            const int corners = above[-1] + above[1] + below[-1] + below[1], sides = above[0] + below[0] + at[-1] + at[1];
            ++counts[std::abs(corners - 2 * sides + 4 * at[0])], ++n;
        }
    if (n == 0) return 0;
    const auto ranked = [&](int64_t rank) {
        int value = 0;
        for (int64_t seen = counts[0]; seen <= rank; seen += counts[value]) ++value;
        return value;
    };
    return 0.5 * (ranked((n - 1) / 2) + ranked(n / 2));
}

SEAMARK_CLONES void apart(const float* points, int64_t n, const float* others, int64_t m, float distance, bool to_each_other,
                          bool* out) {
    const float least = distance * distance;
    const auto crowded = [least](const float* p, const float* among, int64_t count) {
        int near = 0;
        for (int64_t j = 0; j < count; ++j) {
            const float x = among[2 * j] - p[0], y = among[2 * j + 1] - p[1];
            near |= x * x + y * y < least;
        }
        return near != 0;
    };
    for (int64_t i = 0; i < n; ++i) {
        const float* p = points + 2 * i;
        out[i] = !crowded(p, others, m) && !(to_each_other && crowded(p, points, i));
    }
}

}  // namespace seamark
