// The Gaussian scale space of an image and the extrema of its differences: Lowe, "Distinctive Image Features from
// Scale-Invariant Keypoints" (2004), sections 3 and 4.
#pragma once

#include <cstdint>
#include <vector>

#include "pyramid.hpp"
#include "right_of_way.hpp"

namespace seamark {

constexpr int kIntervals = 3;            // scales of an octave that can hold extrema
constexpr int kScales = kIntervals + 3;  // of an octave
constexpr float kSigma = 1.6f;           // blur of its first scale, in pixels of the octave

// Grey levels; rows begin at multiples of 16 numbers, and up to 16 numbers after a row may be read.
struct Plane {
    float* values = nullptr;
    int64_t stride = 0;
    int width = 0, height = 0;
    float* row(int y) const { return values + stride * y; }
};

struct Octave {
    Plane scales[kScales];
};

// Where a difference of Gaussians is larger or smaller than all around it; x, y and sigma in pixels of its octave.
struct Extremum {
    int octave, layer;
    float x, y, sigma, response;
};

// The first octave has twice the pixels of the image per side, each of the others half as many as the one before. The
// planes lie in memory of the thread: they are those of the last image that it has taken.
class ScaleSpace {
public:
    ScaleSpace(const Level& image, float contrast, RightOfWay& way);

    const std::vector<Extremum>& extrema() const { return extrema_; }
    const Octave& octave(int index) const { return octaves_[index]; }

private:
    std::vector<Octave> octaves_;
    std::vector<Extremum> extrema_;
};

}  // namespace seamark
