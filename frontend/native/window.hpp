// Bundle adjustment of the local window with the landmarks eliminated; frontend/window.py says what for.
#pragma once

#include <cstdint>
#include <vector>

#include "seen.hpp"

namespace seamark {

// K poses, the first n_fixed of which hold the gauge, and L landmarks, seen n times; observations are sorted by landmark
// and no keyframe sees a landmark twice.
struct Bundle {
    int64_t n_poses, n_fixed, n_landmarks;
    const int64_t *keyframe_of, *landmark_of;  // (O,)
    Seen seen;
    Lens lens;
    double offset, offset_information;  // what is known about the shared offset of inverse depths
};

struct Adjusted {
    std::vector<double> poses, landmarks;  // (K, 4, 4), (L, 3): the start, then the result
    std::vector<double> errors;            // (O,) whitened pixel errors
    std::vector<double> covariances;       // (L, 3, 3), poses taken for exact
    double offset = 0;
    double depth_information = 0;  // what the observations alone say about the offset, 0 when the window is not solvable
};

// Levenberg-Marquardt with at most `iterations` steps; ends when the cost falls by less than `least_decrease` of itself.
void adjust(const Bundle& bundle, int iterations, double damping, double least_decrease, Adjusted& state);

}  // namespace seamark
