// Pyramidal Lucas-Kanade; frontend/flow.py says what for.
#pragma once

#include <cstdint>

#include "flow_kernels.hpp"
#include "pyramid.hpp"

namespace seamark {

struct FlowSettings {
    int half;           // side of the patch: 2 half + 1
    int top, back_top;  // highest levels on the way there and back
    bool level_out;     // whether the mean of each patch is taken off
    float least_likeness;  // of a patch that is followed back
    float reach;           // how far a patch may move on each level, in pixels of the image
};

// Moves `there` (n, 2) in `after` from where it is to where the patch of `before` around `points` (n, 2) is seen.
// Writes how far from where it began each point comes back (n,), infinity for one that is lost on the way there or back or
// is not like the patch that was sought,
// and the zero-mean normalised correlation (n,) of the patches, 0 for one that is lost on the way there.
void follow(const Pyramid& before, const Pyramid& after, const float* points, int64_t n, const FlowSettings& settings,
            const FlowKernels& kernels, float* there, float* round_trip, float* likeness);

}  // namespace seamark
