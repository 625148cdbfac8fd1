// The pose of one camera from landmarks; frontend/pose.py says what for.
#pragma once

#include <cstdint>

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

// Refines T (4, 4) by at most `iterations` robust Gauss-Newton steps. Writes the normal matrix H (6, 6) of the last
// step and the whitened pixel error (N,) before it. Returns false when the landmarks do not determine the pose.
bool refine_pose(double* T, const Landmarks& landmarks, const Seen& seen, const Lens& lens, const Expected& expected,
                 int iterations, double converged, double* H, double* errors);

// Writes the whitened pixel error (N,) of landmarks seen from T (4, 4), less what their spread explains, and whether
// they are at least `nearest_m` in front; those that are not are taken for the point (0, 0, 1) of the camera.
void pixel_errors(const double* T, const Landmarks& landmarks, const Seen& seen, const Lens& lens, double nearest_m,
                  double* errors, bool* in_front);

}  // namespace seamark
