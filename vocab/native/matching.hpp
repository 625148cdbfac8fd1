// Features that two images share: which of them pair up, and which pairs lie as in one view of one place.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels.hpp"

namespace seamark {

struct Pair {
    int32_t row, column;
    int32_t nearest, next;  // squared distances of the row to its nearest column and to the one after it
};

// Pairs rows (n of 128 bytes) and columns (m >= 2) that are each other's nearest, the first of equally near ones; in the
// order of the rows.
std::vector<Pair> mutual_nearest(const uint8_t* rows, int64_t n, const uint8_t* columns, int64_t m,
                                 const Kernels& kernels);

// Matched features of two images, m of each array.
struct Matches {
    const float *x, *y;                  // in the first image
    const float *to_x, *to_y;            // in the second
    const float *log_scale, *turn;       // of the feature from the first to the second
    int64_t m;
};

// Marks the matches that agree with the one that most agree with, the first of equals: those that its own similarity puts
// within `tolerance` and whose scale changes alike. Matches turned by `most_turn` or more are no hypothesis.
std::vector<uint8_t> best_similarity(const Matches& matches, float tolerance, float scale_step, float most_turn);

}  // namespace seamark
