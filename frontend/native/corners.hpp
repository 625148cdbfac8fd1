// The corner of every cell of a grid, and how far apart points are; frontend/corners.py says what for.
#pragma once

#include <cstdint>
#include <vector>

#include "pyramid.hpp"

namespace seamark {

struct Grid {
    int cell, rows, columns;  // squares from the upper left on
    int border;               // pixels at the border of the image that hold no corner, at least 3
};

// Writes the strongest response of each cell (rows * columns) and its pixel (rows * columns, 2), the first of equal ones
// row by row; 0 where nothing is above it. Shi-Tomasi (the smaller eigenvalue) or Harris with `harris_k` > 0, of sums over
// 5 x 5 of Sobel's slopes of an image taken as 0..1. `mask` (height, width) may be null; where it is zero there is no corner.
void strongest(const Level& image, const Grid& grid, float harris_k, const uint8_t* mask, float* strength, int32_t* pixels);

// Returns the median size of the difference from what the eight pixels around predict (Immerkaer 1996), counted at every
// third pixel of every third row, 0 for an image of less than 3 rows or columns.
double median_difference(const Level& image);

// Says of points (n, 2) whether no other of (m, 2) is nearer than `distance`, nor, with `to_each_other`, a point before it.
void apart(const float* points, int64_t n, const float* others, int64_t m, float distance, bool to_each_other, bool* out);

}  // namespace seamark
