// An octave is made row by row, all its scales together: as soon as the rows that a blur needs are there, it goes on, so
// that all but the planes themselves stays in the second-level cache. The search of a row for extrema follows behind.
#include "scale_space.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <utility>

#include "clones.hpp"

namespace seamark {
namespace {

constexpr int kVector = 16;
constexpr int kTested = 64;  // numbers that are searched at a time
constexpr int kEdge = 5;              // nearer to the border than this there are no extrema
constexpr int kSmallestSide = 16;     // of an octave
constexpr int kRefinements = 5;
constexpr float kEdgeRatio = 10;      // largest ratio of the principal curvatures
constexpr float kCameraSigma = 0.5f;  // blur that an image is taken to have
constexpr int kDifferences = kScales - 1;
constexpr int64_t kKeptFloats = 16 << 20;  // what a thread asked for beyond this goes back at its next image

// Four sigma of each blur, as OpenCV has it: of the base, and of each scale from the one before.
constexpr int kBaseRadius = 5;
constexpr int kRadius[kScales] = {0, 5, 6, 8, 10, 12};
constexpr int kPad = 16;  // floats on either side of a row that is blurred sideways

typedef float Lanes __attribute__((vector_size(4 * kVector)));
typedef int32_t Flags __attribute__((vector_size(4 * kVector)));

SEAMARK_INLINE Lanes load(const float* from) {
    Lanes lanes;
    std::memcpy(&lanes, from, sizeof lanes);
    return lanes;
}
SEAMARK_INLINE void store(float* to, Lanes lanes) { std::memcpy(to, &lanes, sizeof lanes); }
SEAMARK_INLINE Lanes larger(Lanes a, Lanes b) { return a > b ? a : b; }
SEAMARK_INLINE Lanes smaller(Lanes a, Lanes b) { return a < b ? a : b; }

int64_t padded(int width) { return (static_cast<int64_t>(width) + kVector - 1) / kVector * kVector; }

// One half of a symmetric filter, the middle first.
std::vector<float> gaussian(double sigma, int radius) {
    std::vector<double> weights(radius + 1);
    double total = 0;
    for (int k = 0; k <= radius; ++k) {
        weights[k] = std::exp(-0.5 * k * k / (sigma * sigma));
        total += (k ? 2 : 1) * weights[k];
    }
    std::vector<float> half(radius + 1);
    for (int k = 0; k <= radius; ++k) half[k] = static_cast<float>(weights[k] / total);
    return half;
}

struct Filters {
    std::vector<float> blur[kScales];
    // The image is doubled (every other pixel is the mean of its neighbours) and blurred in one step: taps of the pixels
    // -3..3 for the pixels of the double that fall on one of the image, -2..3 for those between.
    float on[7] = {}, between[7] = {};

    Filters() {
        const double step = std::exp2(1.0 / kIntervals);
        for (int s = 1; s < kScales; ++s) {
            const double before = kSigma * std::pow(step, s - 1);
            blur[s] = gaussian(before * std::sqrt(step * step - 1), kRadius[s]);
        }
        const std::vector<float> base =
            gaussian(std::sqrt(kSigma * kSigma - 4 * kCameraSigma * kCameraSigma), kBaseRadius);
        for (int k = -kBaseRadius; k <= kBaseRadius; ++k) {
            const float weight = base[std::abs(k)];
            if (k % 2 == 0) {
                on[k / 2 + 3] += weight;
                between[k / 2 + 2] += 0.5f * weight, between[k / 2 + 3] += 0.5f * weight;
            } else {
                between[(k + 1) / 2 + 2] += weight;
                on[(k - 1) / 2 + 3] += 0.5f * weight, on[(k + 1) / 2 + 3] += 0.5f * weight;
            }
        }
    }
};

const Filters& filters() {
    static const Filters made;
    return made;
}

int mirrored(int i, int n) {
    while (i < 0 || i >= n) i = i < 0 ? -i : 2 * (n - 1) - i;
    return i;
}

void mirror_ends(float* row, int width) {
    for (int k = 1; k < kPad; ++k) row[-k] = row[mirrored(-k, width)], row[width - 1 + k] = row[mirrored(width - 1 + k, width)];
}

// Row y of a plane, blurred. `row` has kPad floats before it and kPad + kVector after its width.
template <int Radius>
SEAMARK_INLINE void blur_row(const Plane& from, const Plane& to, int y, const float* weights, float* row) {
    const float* rows[2 * Radius + 1];
    for (int k = -Radius; k <= Radius; ++k) rows[k + Radius] = from.row(mirrored(y + k, from.height));
    float w[Radius + 1];
    std::copy(weights, weights + Radius + 1, w);
    for (int x = 0; x < from.width; x += kVector) {
        Lanes sum = w[0] * load(rows[Radius] + x);
        for (int k = 1; k <= Radius; ++k) sum += w[k] * (load(rows[Radius - k] + x) + load(rows[Radius + k] + x));
        store(row + x, sum);
    }
    mirror_ends(row, from.width);
    float* out = to.row(y);
    for (int x = 0; x < from.width; x += kVector) {
        Lanes sum = w[0] * load(row + x);
        for (int k = 1; k <= Radius; ++k) sum += w[k] * (load(row + x - k) + load(row + x + k));
        store(out + x, sum);
    }
}

// Row y of the doubled and blurred image.
SEAMARK_INLINE void base_row(const Level& image, const Plane& to, int y, float* row) {
    const Filters& f = filters();
    const int first = y / 2 - (y % 2 ? 2 : 3);
    const float* taps = y % 2 ? f.between : f.on;
    const uint8_t* rows[7];
    for (int k = 0; k < 7; ++k) rows[k] = image.pixels + image.stride * mirrored(first + k, image.height);
#pragma GCC ivdep
    for (int x = 0; x < image.width; ++x) {
        float sum = 0;
        for (int k = 0; k < 7; ++k) sum += taps[k] * static_cast<float>(rows[k][x]);
        row[x] = sum;
    }
    mirror_ends(row, image.width);
    const Flags low = {0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23};
    float* out = to.row(y);
    for (int x = 0; x < image.width; x += kVector) {
        Lanes on = {}, between = {};
        for (int k = 0; k < 7; ++k) {
            on += f.on[k] * load(row + x + k - 3);
            between += f.between[k] * load(row + x + k - 2);
        }
        store(out + 2 * x, __builtin_shuffle(on, between, low));
        if (2 * x + kVector < to.width) store(out + 2 * x + kVector, __builtin_shuffle(on, between, low + 8));
    }
}

SEAMARK_INLINE void halved_row(const Plane& from, const Plane& to, int y) {
    const float* in = from.row(2 * y);
    float* out = to.row(y);
#pragma GCC ivdep
    for (int x = 0; x < to.width; ++x) out[x] = in[2 * x];
}

// Three rows of each difference of scales, and the extremes of three by three of them.
struct Differences {
    int64_t stride;
    std::vector<float> numbers;

    explicit Differences(int width)
        : stride(padded(width) + kTested + 2 * kPad), numbers(stride * (3 * kDifferences + 2 * kIntervals)) {}
    float* row(int difference, int y) { return numbers.data() + stride * (3 * difference + y % 3) + kPad; }
    float* highest(int layer) { return numbers.data() + stride * (3 * kDifferences + layer - 1) + kPad; }
    float* lowest(int layer) { return highest(layer + kIntervals); }
};

SEAMARK_INLINE void subtract_row(const Octave& octave, int y, Differences& differences) {
    for (int d = 0; d < kDifferences; ++d) {
        const float *a = octave.scales[d].row(y), *b = octave.scales[d + 1].row(y);
        float* out = differences.row(d, y);
        for (int x = 0; x < octave.scales[0].width; x += kVector) store(out + x, load(b + x) - load(a + x));
    }
}

// The extremes of each layer and its two neighbours over three rows.
SEAMARK_INLINE void stack_rows(int y, int width, Differences& differences) {
    const float* rows[kDifferences][3];
    for (int d = 0; d < kDifferences; ++d)
        for (int k = 0; k < 3; ++k) rows[d][k] = differences.row(d, y - 1 + k);
    float *high[kIntervals], *low[kIntervals];
    for (int l = 0; l < kIntervals; ++l) high[l] = differences.highest(l + 1), low[l] = differences.lowest(l + 1);
    for (int x = 0; x < width; x += kVector) {
        Lanes most[kDifferences], least[kDifferences];
        for (int d = 0; d < kDifferences; ++d) {
            const Lanes a = load(rows[d][0] + x), b = load(rows[d][1] + x), c = load(rows[d][2] + x);
            most[d] = larger(larger(a, b), c), least[d] = smaller(smaller(a, b), c);
        }
        for (int l = 0; l < kIntervals; ++l) {
            store(high[l] + x, larger(larger(most[l], most[l + 1]), most[l + 2]));
            store(low[l] + x, smaller(smaller(least[l], least[l + 1]), least[l + 2]));
        }
    }
}

// Calls `found` with the columns of a layer's row that exceed the threshold and all numbers around, or the reverse.
template <class Found>
SEAMARK_INLINE void search_row(int layer, int y, int width, float threshold, Differences& differences, Found found) {
    const float *at = differences.row(layer, y), *high = differences.highest(layer), *low = differences.lowest(layer);
    for (int x = 0; x < width; x += kTested) {
        Flags flags[kTested / kVector], some = {};
        for (int k = 0; k < kTested / kVector; ++k) {
            const int here = x + k * kVector;
            const Lanes value = load(at + here);
            const Lanes most = larger(larger(load(high + here - 1), load(high + here)), load(high + here + 1));
            const Lanes least = smaller(smaller(load(low + here - 1), load(low + here)), load(low + here + 1));
            flags[k] = ((value > threshold) & (value >= most)) | ((value < -threshold) & (value <= least));
            some |= flags[k];
        }
        int64_t pairs[kVector / 2], any = 0;
        std::memcpy(pairs, &some, sizeof pairs);
        for (int64_t pair : pairs) any |= pair;
        if (!any) continue;
        int32_t each[kTested];
        std::memcpy(each, flags, sizeof each);
        for (int k = 0; k < kTested; ++k)
            if (each[k]) found(x + k);
    }
}

// Values around one number of the differences, by which a parabola is laid through it.
struct Neighbourhood {
    const Octave& octave;
    int layer, x, y;
    float operator()(int dx, int dy, int dlayer) const {
        const int64_t at = octave.scales[0].stride * (y + dy) + x + dx;
        return octave.scales[layer + dlayer + 1].values[at] - octave.scales[layer + dlayer].values[at];
    }
};

// Moves an extremum to where the parabola has it; false where it is none, is weak, or lies on an edge.
bool refine(const Octave& octave, int layer, int x, int y, float contrast, Extremum& out) {
    double offset[3] = {};
    for (int turn = 0;; ++turn) {
        const Neighbourhood at = {octave, layer, x, y};
        const double centre = at(0, 0, 0);
        const double g[3] = {0.5 * (at(1, 0, 0) - at(-1, 0, 0)), 0.5 * (at(0, 1, 0) - at(0, -1, 0)),
                             0.5 * (at(0, 0, 1) - at(0, 0, -1))};
        const double xx = at(1, 0, 0) + at(-1, 0, 0) - 2 * centre, yy = at(0, 1, 0) + at(0, -1, 0) - 2 * centre,
                     ss = at(0, 0, 1) + at(0, 0, -1) - 2 * centre;
        const double xy = 0.25 * (at(1, 1, 0) - at(-1, 1, 0) - at(1, -1, 0) + at(-1, -1, 0)),
                     xs = 0.25 * (at(1, 0, 1) - at(-1, 0, 1) - at(1, 0, -1) + at(-1, 0, -1)),
                     ys = 0.25 * (at(0, 1, 1) - at(0, -1, 1) - at(0, 1, -1) + at(0, -1, -1));
        // Cramer's rule with the adjugate of the symmetric matrix.
        const double a = yy * ss - ys * ys, b = xs * ys - xy * ss, c = xy * ys - yy * xs;
        const double determinant = xx * a + xy * b + xs * c;
        if (determinant == 0) return false;
        const double d = xx * ss - xs * xs, e = xy * xs - xx * ys, f = xx * yy - xy * xy;
        offset[0] = -(a * g[0] + b * g[1] + c * g[2]) / determinant;
        offset[1] = -(b * g[0] + d * g[1] + e * g[2]) / determinant;
        offset[2] = -(c * g[0] + e * g[1] + f * g[2]) / determinant;
        const double farthest = std::max({std::abs(offset[0]), std::abs(offset[1]), std::abs(offset[2])});
        if (farthest < 0.5) {
            const double value = centre + 0.5 * (g[0] * offset[0] + g[1] * offset[1] + g[2] * offset[2]);
            const double trace = xx + yy;
            if (std::abs(value) * kIntervals < contrast) return false;
            if (f <= 0 || trace * trace * kEdgeRatio >= (kEdgeRatio + 1) * (kEdgeRatio + 1) * f) return false;
            out.layer = layer;
            out.x = static_cast<float>(x + offset[0]), out.y = static_cast<float>(y + offset[1]);
            out.sigma = kSigma * static_cast<float>(std::exp2((layer + offset[2]) / kIntervals));
            out.response = static_cast<float>(std::abs(value));
            return true;
        }
        if (turn + 1 == kRefinements || farthest > octave.scales[0].width) return false;
        x += static_cast<int>(std::lround(offset[0])), y += static_cast<int>(std::lround(offset[1]));
        layer += static_cast<int>(std::lround(offset[2]));
        const Plane& plane = octave.scales[0];
        if (layer < 1 || layer > kIntervals || x < kEdge || x >= plane.width - kEdge || y < kEdge ||
            y >= plane.height - kEdge)
            return false;
    }
}

struct Candidate {
    int layer, x, y;
};

// Makes an octave and finds what may be its extrema. Its first scale is that of the image, or every other pixel of the
// octave before.
SEAMARK_CLONES std::vector<Candidate> make_octave(const Level& image, const Octave* before, float contrast,
                                                  const Octave& octave, RightOfWay& way) {
    std::vector<Candidate> candidates;
    const Plane* scales = octave.scales;
    const int width = scales[0].width, height = scales[0].height;
    std::vector<float> buffer(padded(width) + 2 * kPad + kVector);
    float* row = buffer.data() + kPad;
    Differences differences(width);
    // of a pixel: the refined value decides about the contrast, and is seldom twice what it is refined from
    const float threshold = 0.5f * contrast / kIntervals;
    int delay[kScales] = {};
    for (int s = 1; s < kScales; ++s) delay[s] = delay[s - 1] + kRadius[s];
    const Filters& f = filters();
    const auto has = [height](int y) { return y >= 0 && y < height; };
    for (int y = 0; y < height + delay[kScales - 1] + 1; ++y) {
        way.let_pass();
        if (has(y)) before ? halved_row(before->scales[kIntervals], scales[0], y) : base_row(image, scales[0], y, row);
        if (has(y - delay[1])) blur_row<kRadius[1]>(scales[0], scales[1], y - delay[1], f.blur[1].data(), row);
        if (has(y - delay[2])) blur_row<kRadius[2]>(scales[1], scales[2], y - delay[2], f.blur[2].data(), row);
        if (has(y - delay[3])) blur_row<kRadius[3]>(scales[2], scales[3], y - delay[3], f.blur[3].data(), row);
        if (has(y - delay[4])) blur_row<kRadius[4]>(scales[3], scales[4], y - delay[4], f.blur[4].data(), row);
        if (!has(y - delay[5])) continue;
        const int newest = y - delay[5], at = newest - 1;
        blur_row<kRadius[5]>(scales[4], scales[5], newest, f.blur[5].data(), row);
        subtract_row(octave, newest, differences);
        if (at < kEdge || at >= height - kEdge) continue;
        stack_rows(at, width, differences);
        for (int layer = 1; layer <= kIntervals; ++layer)
            search_row(layer, at, width, threshold, differences, [&](int x) {
                if (x >= kEdge && x < width - kEdge) candidates.push_back({layer, x, at});
            });
    }
    return candidates;
}

// Memory for the planes of one image: a thread that takes image after image does not ask for it anew each time.
struct Arena {
    std::unique_ptr<float[]> floats;
    int64_t size = 0;
    float* with(int64_t wanted) {
        if (wanted > size || size > std::max(wanted, kKeptFloats)) {
            floats.reset(new float[wanted]);
            size = wanted;
        }
        return floats.get();
    }
};

}  // namespace

ScaleSpace::ScaleSpace(const Level& image, float contrast, RightOfWay& way) {
    thread_local Arena arena;
    int64_t wanted = kVector;
    std::vector<std::pair<int, int>> sides;
    for (int w = 2 * image.width, h = 2 * image.height; std::min(w, h) >= kSmallestSide; w /= 2, h /= 2) {
        sides.push_back({w, h});
        wanted += kScales * padded(w) * h + 2 * kVector;
    }
    float* next = arena.with(wanted);
    for (const auto& [width, height] : sides) {
        Octave octave;
        for (Plane& plane : octave.scales) {
            plane = {next, padded(width), width, height};
            next += plane.stride * height;
        }
        octaves_.push_back(octave);
        const int index = static_cast<int>(octaves_.size()) - 1;
        // Refined only now: an extremum may move into rows that were not there when it was found.
        for (const Candidate& c : make_octave(image, index ? &octaves_[index - 1] : nullptr, contrast, octave, way)) {
            Extremum extremum;
            if (!refine(octave, c.layer, c.x, c.y, contrast, extremum)) continue;
            extremum.octave = index;
            extrema_.push_back(extremum);
        }
    }
}

}  // namespace seamark
