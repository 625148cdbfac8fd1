// The loops of Lucas-Kanade over the pixels of one patch, once for each level of the processor; which level runs is
// decided at run time.
//
// Only integers are computed here, so that every level gives the same bits. The files of the levels must not include
// headers of the C++ library: an inline function compiled with wide instructions could be linked into everything.
#pragma once

#include <stdint.h>

namespace seamark {

constexpr int kLanes = 32;     // of a row of a patch
constexpr int kMaxSide = 29;   // of a patch: gradients and interpolation reach three pixels further
constexpr int kGreyUnit = 32;  // grey levels, less 128, and their slopes per pixel are counted in 32nds
constexpr int kPixelUnit = 32768;

// A patch and its slopes (Scharr's filter), rows of kLanes.
struct alignas(64) Template {
    int16_t grey[kMaxSide][kLanes], slope_x[kMaxSide][kLanes], slope_y[kMaxSide][kLanes];
};

// The part of a patch that is compared: rows top..bottom-1 and the columns whose lanes are -1, not 0.
struct alignas(64) Region {
    int16_t columns[kLanes];
    int top, bottom;
};

// Where a patch is read: its first sample is u right of and v below the first pixel, in parts of kPixelUnit.
struct Spot {
    const uint8_t* pixels;
    int64_t stride;
    int16_t u, v;
};

struct FlowKernels {
    const char* name;

    // Reads `side` rows of a patch and its slopes; one row and column more is read before and two after it.
    void (*read)(const Spot& spot, int side, Template& out);

    // Sums over a region: slope_x^2, slope_x slope_y, slope_y^2, slope_x, slope_y.
    void (*curvature)(const Template& model, const Region& region, int64_t* sums);

    // Sums of what the patch at a spot exceeds the model by: times slope_x, times slope_y, alone.
    void (*mismatch)(const Template& model, const Spot& spot, const Region& region, int64_t* sums);

    // Sums of the model m and the patch p at a spot: m, p, m^2, m p, p^2.
    void (*likeness)(const Template& model, const Spot& spot, const Region& region, int64_t* sums);
};

extern const FlowKernels kFlowBaseline;
#if defined(SEAMARK_X86_LEVELS)
extern const FlowKernels kFlowAvx2;
extern const FlowKernels kFlowAvx512;
#endif

// The levels this processor has, from the slowest to the fastest, as a list that ends with nullptr.
const FlowKernels* const* flow_levels();

}  // namespace seamark
