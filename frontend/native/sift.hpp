// SIFT: key points of the scale space, their orientations and descriptors (Lowe 2004, sections 3 to 6).
#pragma once

#include <cstdint>
#include <vector>

#include "pyramid.hpp"
#include "right_of_way.hpp"

namespace seamark {

constexpr int kDescriptor = 128;

// One row per key point: x, y and diameter in pixels of the image, angle in degrees, response; and its descriptor.
struct KeyPoints {
    std::vector<float> table;  // (N, 5)
    std::vector<uint8_t> descriptors;
};

// Finds the `most` strongest key points whose response times the intervals of an octave reaches `contrast` (grey levels),
// strongest first, then by x, y and angle. `mask` (height, width) may be null; where it is zero there is none. Who takes
// `way` meanwhile is let pass.
KeyPoints sift(const Level& image, const uint8_t* mask, int64_t most, float contrast, RightOfWay& way);

}  // namespace seamark
