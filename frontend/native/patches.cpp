// All samples of an unwarped patch share their fractions of a pixel, and interpolation commutes with Scharr's filter:
// 19 x 18 pixels give the patch and both gradients, and no image of gradients is ever made.
#include "patches.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "clones.hpp"

namespace seamark {
namespace {

constexpr int kHalf = 7, kSide = 2 * kHalf + 1;
constexpr int kAround = kHalf + 1;        // gradients reach one pixel further
constexpr int kRows = 2 * kAround + 1;    // of samples
constexpr int kStride = 24;               // of samples and pixels: 18 and 19 are used
constexpr float kSigma = 4.4f, kMaxStep = 1.0f, kMinCurvature = 1e-3f, kMinEnergy = 1e-6f;
constexpr int kLineIterations = 6, kWarpIterations = 3;
constexpr float kFar = 1e6f;              // positions beyond are nonsense

// One row of a patch, and a lane of no weight. GCC holds vectors to an alignment that depends on the level it compiles
// for, so none is asked of the type.
typedef float Lanes __attribute__((vector_size(64), aligned(4)));

struct alignas(64) Patch {
    Lanes image[kSide], gradient_x[kSide], gradient_y[kSide];
};

struct alignas(64) Window {
    Lanes weight[kSide];

    Window() {
        double sum = 0, value[kSide][kSide];
        for (int y = 0; y < kSide; ++y)
            for (int x = 0; x < kSide; ++x) {
                const double square = (x - kHalf) * (x - kHalf) + (y - kHalf) * (y - kHalf);
                sum += value[y][x] = std::exp(-square / (2.0 * kSigma * kSigma));
            }
        for (int y = 0; y < kSide; ++y)
            for (int x = 0; x < 16; ++x) weight[y][x] = x < kSide ? static_cast<float>(value[y][x] / sum) : 0.0f;
    }
};

const Window kWindow;

SEAMARK_INLINE void load(const float* from, Lanes& to) { std::memcpy(&to, from, sizeof to); }

SEAMARK_INLINE float total(const Lanes& lanes) {
    float half[8];
    for (int i = 0; i < 8; ++i) half[i] = lanes[i] + lanes[i + 8];
    return ((half[0] + half[4]) + (half[1] + half[5])) + ((half[2] + half[6]) + (half[3] + half[7]));
}

SEAMARK_INLINE void centre(Lanes* patch) {
    Lanes sum = {};
    for (int y = 0; y < kSide; ++y) sum += kWindow.weight[y] * patch[y];
    const float mean = total(sum);
    for (int y = 0; y < kSide; ++y) patch[y] -= mean;
}

SEAMARK_INLINE bool sane(const float* p) { return std::fabs(p[0]) < kFar && std::fabs(p[1]) < kFar; }

SEAMARK_INLINE int clamped(int i, int n) { return std::min(std::max(i, 0), n - 1); }
SEAMARK_INLINE int mirrored(int i, int n) { return clamped(i < 0 ? -i : i >= n ? 2 * n - 2 - i : i, n); }

// Interpolates between the rows and columns of 16 x 24 values.
SEAMARK_INLINE void between(const float values[kSide + 1][kStride], float u, float v, Lanes* out) {
    for (int y = 0; y < kSide; ++y) {
        Lanes at[2][2];
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) load(values[y + i] + j, at[i][j]);
        const Lanes left = at[0][0] + v * (at[1][0] - at[0][0]), right = at[0][1] + v * (at[1][1] - at[0][1]);
        out[y] = left + u * (right - left);
    }
}

// The same as below where the patch reaches the border: values beyond are those of the border, and no gradient leads
// across it, so that what is not in the image does not pull.
SEAMARK_INLINE void sample_at_border(const Level& image, int left, int top, float u, float v, Patch& out) {
    float grey[kSide + 1][kStride], across[kSide + 1][kStride], down[kSide + 1][kStride];
    for (int i = 0; i <= kSide; ++i)
        for (int j = 0; j < kStride; ++j) {
            const int x = clamped(left + j, image.width), y = clamped(top + i, image.height);
            float at[3][3];
            for (int dy = -1; dy <= 1; ++dy)
                for (int dx = -1; dx <= 1; ++dx)
                    at[dy + 1][dx + 1] = image.pixels[image.stride * mirrored(y + dy, image.height) +
                                                      mirrored(x + dx, image.width)];
            grey[i][j] = at[1][1];
            across[i][j] = (3 * (at[0][2] - at[0][0] + at[2][2] - at[2][0]) + 10 * (at[1][2] - at[1][0])) / 32;
            down[i][j] = (3 * (at[2][0] - at[0][0] + at[2][2] - at[0][2]) + 10 * (at[2][1] - at[0][1])) / 32;
        }
    between(grey, u, v, out.image);
    between(across, u, v, out.gradient_x);
    between(down, u, v, out.gradient_y);
    centre(out.image);
}

// Reads the patch around a point, taking off its mean; with gradients in grey levels per pixel.
SEAMARK_INLINE void sample(const Level& image, const float* point, Patch& out) {
    const float floor_x = std::floor(point[0]), floor_y = std::floor(point[1]);
    const float u = point[0] - floor_x, v = point[1] - floor_y;
    const int left = static_cast<int>(floor_x) - kAround, top = static_cast<int>(floor_y) - kAround;
    if (left < 0 || top < 0 || left + kStride > image.width || top + kRows + 1 > image.height) {
        sample_at_border(image, left + 1, top + 1, u, v, out);
        return;
    }
    float pixels[kRows + 1][kStride], samples[kRows][kStride];
    for (int y = 0; y <= kRows; ++y)
        for (int x = 0; x < kStride; ++x) pixels[y][x] = image.pixels[image.stride * (top + y) + left + x];
    for (int y = 0; y < kRows; ++y) {
        float column[kStride];
        for (int x = 0; x < kStride; ++x) column[x] = pixels[y][x] + v * (pixels[y + 1][x] - pixels[y][x]);
        for (int x = 0; x < kStride - 1; ++x) samples[y][x] = column[x] + u * (column[x + 1] - column[x]);
        samples[y][kStride - 1] = 0;
    }
    for (int y = 0; y < kSide; ++y) {
        Lanes at[3][3];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) load(samples[y + i] + j, at[i][j]);
        out.image[y] = at[1][1];
        out.gradient_x[y] = (3.0f * (at[0][2] - at[0][0] + at[2][2] - at[2][0]) + 10.0f * (at[1][2] - at[1][0])) / 32.0f;
        out.gradient_y[y] = (3.0f * (at[2][0] - at[0][0] + at[2][2] - at[0][2]) + 10.0f * (at[2][1] - at[0][1])) / 32.0f;
    }
    centre(out.image);
}

SEAMARK_INLINE float limited(float step) { return std::min(std::max(step, -kMaxStep), kMaxStep); }

SEAMARK_INLINE float correlation(const Lanes* seen, const Lanes* model) {
    Lanes product = {}, own = {}, other = {};
    for (int y = 0; y < kSide; ++y) {
        const Lanes weighted = kWindow.weight[y] * seen[y];
        product += weighted * model[y];
        own += weighted * seen[y];
        other += kWindow.weight[y] * model[y] * model[y];
    }
    return total(product) / std::sqrt(std::max(total(own) * total(other), kMinEnergy));
}

SEAMARK_INLINE void step_along(const Patch& now, const Lanes* model, const float* along, float* there) {
    Lanes slope[kSide], curvature = {}, pull = {};
    for (int y = 0; y < kSide; ++y) slope[y] = now.gradient_x[y] * along[0] + now.gradient_y[y] * along[1];
    centre(slope);
    for (int y = 0; y < kSide; ++y) {
        const Lanes weighted = kWindow.weight[y] * slope[y];
        curvature += weighted * slope[y];
        pull += weighted * (now.image[y] - model[y]);
    }
    const float step = limited(-total(pull) / std::max(total(curvature), kMinCurvature));
    there[0] += step * along[0];
    there[1] += step * along[1];
}

SEAMARK_INLINE void step_freely(Patch& now, const Lanes* model, float* there) {
    centre(now.gradient_x);
    centre(now.gradient_y);
    Lanes sums[5] = {};
    for (int y = 0; y < kSide; ++y) {
        const Lanes difference = now.image[y] - model[y];
        const Lanes x = kWindow.weight[y] * now.gradient_x[y], z = kWindow.weight[y] * now.gradient_y[y];
        sums[0] += x * now.gradient_x[y];
        sums[1] += x * now.gradient_y[y];
        sums[2] += z * now.gradient_y[y];
        sums[3] += x * difference;
        sums[4] += z * difference;
    }
    const float xx = total(sums[0]), xy = total(sums[1]), yy = total(sums[2]), bx = total(sums[3]), by = total(sums[4]);
    const float determinant = std::max(xx * yy - xy * xy, kMinCurvature * kMinCurvature);
    there[0] += limited(-(yy * bx - xy * by) / determinant);
    there[1] += limited(-(xx * by - xy * bx) / determinant);
}

// Reads a patch whose offsets are changed by a (2, 2) matrix, taking off its mean.
SEAMARK_INLINE void sample_changed(const Level& image, const float* point, const float* change, Lanes* out) {
    for (int y = 0; y < kSide; ++y) {
        float row[16] = {};
        for (int x = 0; x < kSide; ++x) {
            const float dx = static_cast<float>(x - kHalf), dy = static_cast<float>(y - kHalf);
            const float at_x = std::min(std::max(point[0] + change[0] * dx + change[1] * dy, 0.0f), image.width - 1.0f);
            const float at_y = std::min(std::max(point[1] + change[2] * dx + change[3] * dy, 0.0f), image.height - 1.0f);
            const int left = static_cast<int>(at_x), top = static_cast<int>(at_y);
            const int right = std::min(left + 1, image.width - 1), below = std::min(top + 1, image.height - 1);
            const uint8_t* upper = image.pixels + image.stride * top;
            const uint8_t* lower = image.pixels + image.stride * below;
            const float u = at_x - left, v = at_y - top;
            const float over = upper[left] + u * (upper[right] - upper[left]);
            const float under = lower[left] + u * (lower[right] - lower[left]);
            row[x] = over + v * (under - over);
        }
        load(row, out[y]);
    }
    centre(out);
}

}  // namespace

SEAMARK_CLONES void align_along(const Level& source, const Level& target, const float* points, const float* directions,
                                int64_t n, float* there, float* correlations) {
    Patch model, now;
    for (int64_t i = 0; i < n; ++i, points += 2, directions += 2, there += 2) {
        correlations[i] = 0;
        if (!sane(points) || !sane(there) || !sane(directions)) continue;
        sample(source, points, model);
        for (int k = 0; k < kLineIterations; ++k) {
            sample(target, there, now);
            step_along(now, model.image, directions, there);
        }
        sample(target, there, now);
        correlations[i] = correlation(now.image, model.image);
    }
}

SEAMARK_CLONES void align_warped(const Level& source, const Level& target, const float* points, const float* unwarp,
                                 int64_t n, float* there, float* correlations) {
    Patch now;
    Lanes model[kSide];
    for (int64_t i = 0; i < n; ++i, points += 2, unwarp += 4, there += 2) {
        correlations[i] = 0;
        if (!sane(points) || !sane(there) || !sane(unwarp) || !sane(unwarp + 2)) continue;
        sample_changed(source, points, unwarp, model);
        for (int k = 0; k < kWarpIterations; ++k) {
            sample(target, there, now);
            step_freely(now, model, there);
        }
        sample(target, there, now);
        correlations[i] = correlation(now.image, model);
    }
}

}  // namespace seamark
