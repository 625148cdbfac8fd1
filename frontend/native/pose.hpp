// The pose of one camera from landmarks; frontend/pose.py says what for.
#pragma once

#include <cstdint>
#include <vector>

#include "seen.hpp"

namespace seamark {

struct Landmarks {
    const double* positions;  // (N, 3) in the odometry frame
    const double* spread;     // (N,) relative sigma of the distance from `origin`, nullptr for exact ones
    const double* origin;     // (3,)
};

struct Expected {
    const double* position;  // (3,), nullptr for nothing
    double sigma_m;
};

struct PoseSettings {
    Lens lens;
    Expected expected;
    double threshold_px, nearest_m;  // what an inlier is
    int64_t minimum;                 // of them
    int iterations;                  // robust Gauss-Newton steps at most
    double converged;                // the length of a step that is the last
};

struct ConvergedPose {
    double T[16], H[36];          // the pose (4, 4) and the normal matrix (6, 6) of its last step
    std::vector<char> inliers;    // (N,)
    double noise;                 // median whitened error of what it was refined on
    double error_px;              // median error of the inliers
    double score;                 // sum of all errors, truncated at the threshold, times their votes
};

// Refines T (4, 4) on the inliers (N,) that `state` comes with, then on those it leads to, if they are others. `votes` (N,)
// weigh the score. Returns false where the landmarks do not determine the pose or fewer than the minimum agree with it.
bool converge(const Landmarks& landmarks, const Seen& seen, const double* votes, const PoseSettings& settings,
              ConvergedPose& state);

}  // namespace seamark
