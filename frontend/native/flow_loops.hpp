// The loops in terms of a row of kLanes 16-bit numbers; each level says what a row and a sum of products are, in a
// namespace of its own.
//
// No sum overflows 32 bits: differences stay below 255, slopes below 127.5 grey levels, 29 rows of two products each.
#pragma once

#include "flow_kernels.hpp"

namespace seamark {
namespace {

// Interpolates between a row of pixels and the one shifted by one.
template <class Row>
inline Row across(const uint8_t* pixels, const Row& u) {
    const Row left = Row::of_pixels(pixels), right = Row::of_pixels(pixels + 1);
    return left + (right - left).times(u);
}

template <class Row>
void read_template(const Spot& spot, int side, Template& out) {
    // Rows and columns from -1 to `side`; slopes are taken of samples, since interpolation commutes with the filter.
    alignas(64) int16_t samples[kMaxSide + 2][kLanes + 32];
    const Row u = Row::all(spot.u), v = Row::all(spot.v);
    const uint8_t* pixels = spot.pixels - spot.stride - 1;
    Row above = across(pixels, u);
    for (int y = 0; y < side + 2; ++y) {
        pixels += spot.stride;
        const Row below = across(pixels, u);
        (above + (below - above).times(v)).store(samples[y]);
        Row::all(0).store(samples[y] + kLanes);
        above = below;
    }
    const Row three = Row::all(3 * (kPixelUnit / 32)), ten = Row::all(10 * (kPixelUnit / 32));
    for (int y = 0; y < side; ++y) {
        Row at[3][3];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) at[i][j] = Row::load(samples[y + i] + j);
        at[1][1].store(out.grey[y]);
        const Row right = (at[0][2] - at[0][0]) + (at[2][2] - at[2][0]);
        const Row down = (at[2][0] - at[0][0]) + (at[2][2] - at[0][2]);
        (right.times(three) + (at[1][2] - at[1][0]).times(ten)).store(out.slope_x[y]);
        (down.times(three) + (at[2][1] - at[0][1]).times(ten)).store(out.slope_y[y]);
    }
}

template <class Row>
void sum_curvature(const Template& model, const Region& region, int64_t* sums) {
    const Row columns = Row::load(region.columns), one = Row::all(1);
    typename Row::Sum xx, xy, yy, x, y;
    for (int i = region.top; i < region.bottom; ++i) {
        const Row slope_x = Row::load(model.slope_x[i]) & columns, slope_y = Row::load(model.slope_y[i]) & columns;
        xx.add(slope_x, slope_x);
        xy.add(slope_x, slope_y);
        yy.add(slope_y, slope_y);
        x.add(slope_x, one);
        y.add(slope_y, one);
    }
    sums[0] = xx.total(), sums[1] = xy.total(), sums[2] = yy.total(), sums[3] = x.total(), sums[4] = y.total();
}

template <class Row>
void sum_mismatch(const Template& model, const Spot& spot, const Region& region, int64_t* sums) {
    const Row columns = Row::load(region.columns), one = Row::all(1), u = Row::all(spot.u), v = Row::all(spot.v);
    const uint8_t* pixels = spot.pixels + spot.stride * region.top;
    Row above = across(pixels, u);
    typename Row::Sum by_x, by_y, alone;
    for (int i = region.top; i < region.bottom; ++i) {
        pixels += spot.stride;
        const Row below = across(pixels, u);
        const Row off = (above + (below - above).times(v) - Row::load(model.grey[i])) & columns;
        by_x.add(off, Row::load(model.slope_x[i]));
        by_y.add(off, Row::load(model.slope_y[i]));
        alone.add(off, one);
        above = below;
    }
    sums[0] = by_x.total(), sums[1] = by_y.total(), sums[2] = alone.total();
}

template <class Row>
void sum_likeness(const Template& model, const Spot& spot, const Region& region, int64_t* sums) {
    const Row columns = Row::load(region.columns), one = Row::all(1), u = Row::all(spot.u), v = Row::all(spot.v);
    const uint8_t* pixels = spot.pixels + spot.stride * region.top;
    Row above = across(pixels, u);
    typename Row::Sum m, p, mm, mp, pp;
    for (int i = region.top; i < region.bottom; ++i) {
        pixels += spot.stride;
        const Row below = across(pixels, u);
        const Row seen = (above + (below - above).times(v)) & columns, expected = Row::load(model.grey[i]) & columns;
        m.add(expected, one);
        p.add(seen, one);
        mm.add(expected, expected);
        mp.add(expected, seen);
        pp.add(seen, seen);
        above = below;
    }
    sums[0] = m.total(), sums[1] = p.total(), sums[2] = mm.total(), sums[3] = mp.total(), sums[4] = pp.total();
}

template <class Row>
constexpr FlowKernels flow_kernels_of(const char* name) {
    return {name, read_template<Row>, sum_curvature<Row>, sum_mismatch<Row>, sum_likeness<Row>};
}

}  // namespace
}  // namespace seamark
