// Sub-pixel alignment of square patches; frontend/patches.py says what for.
#pragma once

#include <cstdint>

#include "pyramid.hpp"

namespace seamark {

// Moves `there` (n, 2) in `target` along unit `directions` (n, 2) until its patch looks like that of `source` around
// `points` (n, 2). Writes the correlations (n,) at the end.
void align_along(const Level& source, const Level& target, const float* points, const float* directions, int64_t n,
                 float* there, float* correlations);

// Moves `there` (n, 2) in `target` until its patch looks like that of `source` around `points` (n, 2), whose offsets
// are those of the target times `unwarp` (n, 2, 2).
void align_warped(const Level& source, const Level& target, const float* points, const float* unwarp, int64_t n,
                  float* there, float* correlations);

}  // namespace seamark
