#include "sift.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>
#include <tuple>

#include "clones.hpp"
#include "scale_space.hpp"

namespace seamark {
namespace {

constexpr float kTurn = 6.28318530718f;

// Orientation: a histogram of directions within three times 1.5 sigma.
constexpr int kBins = 36;
constexpr float kOrientationSigma = 1.5f;
constexpr float kPeak = 0.8f;  // of the highest bin: another orientation

// Descriptor: 4 x 4 parts of three sigma each, with 8 directions.
constexpr int kParts = 4, kDirections = 8;
constexpr float kPartSigmas = 3;
constexpr float kLargest = 0.2f;  // of a descriptor of length one, before it is normalised once more
constexpr float kLength = 512;
constexpr int kVector = 16;
constexpr int kRowFloats = 512;  // of a row of samples around a key point at most

// The directions of one part of a descriptor.
typedef float Directions __attribute__((vector_size(4 * kDirections)));

struct Oriented {
    const Extremum* extremum;
    float degrees;
};

// The direction of a slope in turns, 0..1, to 1e-5 of a radian (Abramowitz and Stegun 4.4.49).
SEAMARK_INLINE float turns_of(float y, float x) {
    const float ax = std::abs(x), ay = std::abs(y);
    const float ratio = std::min(ax, ay) / (std::max(ax, ay) + 1e-20f), s = ratio * ratio;
    float angle = ratio * (1 + s * (-0.3333314528f + s * (0.1999355085f + s * (-0.1420889944f + s * (0.1065626393f +
                  s * (-0.0752896400f + s * (0.0429096138f + s * (-0.0161657367f + s * 0.0028662257f))))))));
    angle *= 1 / kTurn;
    angle = ay > ax ? 0.25f - angle : angle;
    angle = x < 0 ? 0.5f - angle : angle;
    return y < 0 ? 1 - angle : angle;
}

// exp(-k^2 / (2 sigma^2)) for k = 0..radius.
std::vector<float> bell(float sigma, int radius) {
    std::vector<float> weights(radius + 1);
    for (int k = 0; k <= radius; ++k) weights[k] = static_cast<float>(std::exp(-0.5 * k * k / (static_cast<double>(sigma) * sigma)));
    return weights;
}

// Slopes of n samples of a row, from `first` on relative to (x, y): their size, weighted, and their direction in turns.
// Whole vectors are read and written.
SEAMARK_INLINE void slopes(const Plane& plane, int x, int y, int first, int n, const float* weights, float weight,
                           float* size, float* turns) {
    const float *at = plane.row(y) + x + first, *above = at - plane.stride, *below = at + plane.stride;
    for (int k = 0; k < n; k += kVector)
        for (int j = k; j < k + kVector; ++j) {
            const float dx = at[j + 1] - at[j - 1], dy = above[j] - below[j];
            size[j] = std::sqrt(dx * dx + dy * dy) * weight * weights[j + first];
            turns[j] = turns_of(dy, dx);
        }
}

// Weights for -radius..radius, the middle at [radius], and zeros that a whole vector more can be read.
std::vector<float> both_sides(const std::vector<float>& half) {
    std::vector<float> whole(half.rbegin(), half.rend());
    whole.insert(whole.end(), half.begin() + 1, half.end());
    whole.resize(whole.size() + kVector);
    return whole;
}

// Appends the orientations of one extremum.
SEAMARK_CLONES void orient(const Plane& plane, const Extremum& extremum, std::vector<Oriented>& out) {
    const float sigma = kOrientationSigma * extremum.sigma;
    const int radius = std::min(static_cast<int>(std::lrint(3 * sigma)), (kRowFloats - kVector) / 2 - 1);
    const int x = static_cast<int>(std::lrint(extremum.x)), y = static_cast<int>(std::lrint(extremum.y));
    const std::vector<float> weights = both_sides(bell(sigma, radius));
    float histogram[kBins] = {};
    alignas(64) float size[kRowFloats], turns[kRowFloats];
    const int first = std::max(-radius, 1 - x), last = std::min(radius, plane.width - 2 - x) + 1;
    for (int i = std::max(-radius, 1 - y); i <= std::min(radius, plane.height - 2 - y); ++i) {
        slopes(plane, x, y + i, first, last - first, weights.data() + radius, weights[i + radius], size, turns);
        for (int j = 0; j < last - first; ++j) {
            const int bin = static_cast<int>(kBins * turns[j] + 0.5f);
            histogram[bin >= kBins ? bin - kBins : bin] += size[j];
        }
    }
    float smooth[kBins];
    const auto at = [&](int bin) { return histogram[(bin + kBins) % kBins]; };
    for (int b = 0; b < kBins; ++b)
        smooth[b] = (at(b - 2) + at(b + 2)) * (1 / 16.f) + (at(b - 1) + at(b + 1)) * (4 / 16.f) + at(b) * (6 / 16.f);
    const float least = kPeak * *std::max_element(smooth, smooth + kBins);
    for (int b = 0; b < kBins; ++b) {
        const float left = smooth[(b + kBins - 1) % kBins], right = smooth[(b + 1) % kBins];
        if (!(smooth[b] > left && smooth[b] > right && smooth[b] >= least)) continue;
        const float peak = b + 0.5f * (left - right) / (left - 2 * smooth[b] + right);
        const float degrees = 360 - (360.f / kBins) * peak;
        out.push_back({&extremum, degrees >= 360 ? degrees - 360 : degrees < 0 ? degrees + 360 : degrees});
    }
}

// Narrows first..last to the j for which |a j + b| < limit.
void narrow(float a, float b, float limit, int& first, int& last) {
    if (std::abs(a) < 1e-6f) {
        if (std::abs(b) >= limit) last = first - 1;
        return;
    }
    const float one = (-limit - b) / a, other = (limit - b) / a;
    first = std::max(first, static_cast<int>(std::ceil(std::min(one, other))));
    last = std::min(last, static_cast<int>(std::floor(std::max(one, other))));
}

// Writes the descriptor of a key point.
SEAMARK_CLONES void describe(const Plane& plane, const Oriented& key_point, uint8_t* out) {
    constexpr int kSide = kParts + 2;
    const Directions each = {0, 1, 2, 3, 4, 5, 6, 7};
    const Extremum& extremum = *key_point.extremum;
    const float part = kPartSigmas * extremum.sigma, half = 0.5f * (kParts + 1);
    const int whole = static_cast<int>(std::hypot(plane.width, plane.height));
    const int radius = std::min({static_cast<int>(std::lrint(part * 1.41421356f * half)), whole, (kRowFloats - kVector) / 2 - 1});
    const int x = static_cast<int>(std::lrint(extremum.x)), y = static_cast<int>(std::lrint(extremum.y));
    const std::vector<float> weights = both_sides(bell(0.5f * kParts * part, radius));
    const double angle = (360.0 - key_point.degrees) * (kTurn / 360.0);
    const float start = static_cast<float>((360.0 - key_point.degrees) / 360.0);
    const float cosine = static_cast<float>(std::cos(angle)) / part, sine = static_cast<float>(std::sin(angle)) / part;

    Directions histogram[kSide * kSide] = {};
    alignas(64) float size[kRowFloats], turns[kRowFloats], shares[4][kRowFloats];
    alignas(64) int32_t parts[kRowFloats];
    const float middle = 0.5f * kParts - 0.5f + 1;  // of the histogram, which has one part more on each side
    for (int i = std::max(-radius, 1 - y); i <= std::min(radius, plane.height - 2 - y); ++i) {
        int first = std::max(-radius, 1 - x), last = std::min(radius, plane.width - 2 - x);
        narrow(cosine, -i * sine, half, first, last);
        narrow(sine, i * cosine, half, first, last);
        if (last < first) continue;
        const int n = last + 1 - first;
        slopes(plane, x, y + i, first, n, weights.data() + radius, weights[i + radius], size, turns);
        for (int k = 0; k < n; k += kVector)
            for (int j = k; j < k + kVector; ++j) {
                const float along = static_cast<float>(j + first);
                const float column = std::min(std::max(along * cosine - i * sine + middle, 0.f), kSide - 1.001f);
                const float row = std::min(std::max(along * sine + i * cosine + middle, 0.f), kSide - 1.001f);
                const int r = static_cast<int>(row), c = static_cast<int>(column);
                const float dr = row - static_cast<float>(r), dc = column - static_cast<float>(c);
                const float lower = size[j] * dr, upper = size[j] - lower;
                shares[1][j] = upper * dc, shares[0][j] = upper - shares[1][j];
                shares[3][j] = lower * dc, shares[2][j] = lower - shares[3][j];
                parts[j] = r * kSide + c;
                const float turned = turns[j] - start;
                turns[j] = kDirections * (turned < 0 ? turned + 1 : turned);
            }
        for (int k = 0; k < n; ++k) {
            // of a direction between two of the eight each gets the more the nearer it is
            Directions apart = turns[k] - each;
            apart = apart < 0 ? -apart : apart;
            const Directions around = kDirections - apart;
            Directions share = 1 - (apart < around ? apart : around);
            share = share > 0 ? share : 0 * share;
            Directions* at = histogram + parts[k];
            at[0] += shares[0][k] * share, at[1] += shares[1][k] * share;
            at[kSide] += shares[2][k] * share, at[kSide + 1] += shares[3][k] * share;
        }
    }

    float values[kDescriptor];
    for (int r = 0; r < kParts; ++r)
        for (int c = 0; c < kParts; ++c)
            std::memcpy(values + (r * kParts + c) * kDirections, histogram + (r + 1) * kSide + c + 1, sizeof(Directions));
    const auto length = [&values] {
        float sum = 0;
        for (float value : values) sum += value * value;
        return std::sqrt(sum);
    };
    const float largest = kLargest * length();
    for (float& value : values) value = std::min(value, largest);
    const float scale = kLength / std::max(length(), 1e-7f);
    for (int k = 0; k < kDescriptor; ++k) out[k] = static_cast<uint8_t>(std::min(std::nearbyint(values[k] * scale), 255.f));
}

// Neighbours in the picture one after the other, so that what one has read is there for the next.
std::vector<size_t> in_memory_order(const std::vector<Oriented>& oriented) {
    std::vector<size_t> order(oriented.size());
    std::iota(order.begin(), order.end(), size_t{0});
    const auto place = [&oriented](size_t k) {
        const Extremum& e = *oriented[k].extremum;
        return std::make_tuple(e.octave, e.layer, e.y, k);
    };
    std::sort(order.begin(), order.end(), [&place](size_t a, size_t b) { return place(a) < place(b); });
    return order;
}

}  // namespace

KeyPoints sift(const Level& image, const uint8_t* mask, int64_t most, float contrast, RightOfWay& way) {
    const ScaleSpace space(image, contrast, way);
    const auto unit = [](const Extremum& e) { return std::ldexp(0.5f, e.octave); };  // pixels of the image
    const auto allowed = [&](const Extremum& e) {
        const int x = static_cast<int>(std::lrint(e.x * unit(e))), y = static_cast<int>(std::lrint(e.y * unit(e)));
        return mask[static_cast<int64_t>(std::min(y, image.height - 1)) * image.width + std::min(x, image.width - 1)] != 0;
    };
    std::vector<Extremum> extrema;
    for (const Extremum& extremum : space.extrema())
        if (!mask || allowed(extremum)) extrema.push_back(extremum);
    const auto order = [&](const Extremum& e) { return std::make_tuple(-e.response, e.x * unit(e), e.y * unit(e), e.sigma); };
    std::sort(extrema.begin(), extrema.end(), [&](const auto& a, const auto& b) { return order(a) < order(b); });
    // Neighbours that have moved to the same place are one.
    const auto same = [&](const auto& a, const auto& b) { return order(a) == order(b); };
    extrema.erase(std::unique(extrema.begin(), extrema.end(), same), extrema.end());

    const auto plane = [&space](const Extremum& e) { return space.octave(e.octave).scales[e.layer]; };
    std::vector<Oriented> oriented;
    for (const Extremum& extremum : extrema) {
        if (static_cast<int64_t>(oriented.size()) >= most) break;
        way.let_pass();
        orient(plane(extremum), extremum, oriented);
    }
    oriented.resize(std::min<size_t>(oriented.size(), most));

    KeyPoints found;
    found.table.reserve(5 * oriented.size());
    found.descriptors.resize(kDescriptor * oriented.size());
    for (const Oriented& key_point : oriented) {
        const Extremum& e = *key_point.extremum;
        const float pixel = unit(e);
        found.table.insert(found.table.end(), {e.x * pixel, e.y * pixel, 2 * e.sigma * pixel, key_point.degrees, e.response});
    }
    for (size_t k : in_memory_order(oriented)) {
        way.let_pass();
        describe(plane(*oriented[k].extremum), oriented[k], found.descriptors.data() + kDescriptor * k);
    }
    return found;
}

}  // namespace seamark
