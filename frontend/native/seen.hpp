// How a camera sees a point: whitened residuals of pixel and inverse depth and their derivatives. frontend/residuals.py
// says the same in numpy.
#pragma once

#include <cmath>
#include <cstdint>

#include "clones.hpp"

namespace seamark {

constexpr double kHuber = 1.345;

struct Lens {
    double fx, fy, cx, cy, pixel_sigma;
};

// N observations as arrays; readings of inverse depth are NaN where there are none.
struct Seen {
    int64_t n;
    const double* pixels;         // (N, 2), undistorted
    const double* inverse_depth;  // (N,)
    const double* inverse_sigma;  // (N,)
};

struct Residual {
    double r[3];     // u, v, inverse depth
    double J[3][3];  // by the point in the camera
};

SEAMARK_INLINE void observe(const double* in_cam, const Seen& seen, int64_t i, const Lens& lens, Residual& out) {
    const double x = in_cam[0], y = in_cam[1], inverse = 1 / in_cam[2], scale = 1 / lens.pixel_sigma;
    out.r[0] = (lens.fx * x * inverse + lens.cx - seen.pixels[2 * i]) * scale;
    out.r[1] = (lens.fy * y * inverse + lens.cy - seen.pixels[2 * i + 1]) * scale;
    out.J[0][0] = lens.fx * inverse * scale, out.J[0][1] = 0, out.J[0][2] = -lens.fx * x * inverse * inverse * scale;
    out.J[1][0] = 0, out.J[1][1] = lens.fy * inverse * scale, out.J[1][2] = -lens.fy * y * inverse * inverse * scale;
    out.J[2][0] = out.J[2][1] = out.J[2][2] = out.r[2] = 0;
    if (std::isfinite(seen.inverse_depth[i])) {
        out.r[2] = (inverse - seen.inverse_depth[i]) / seen.inverse_sigma[i];
        out.J[2][2] = -inverse * inverse / seen.inverse_sigma[i];
    }
}

SEAMARK_INLINE double huber_weight(double norm) { return norm > kHuber ? kHuber / norm : 1.0; }
SEAMARK_INLINE double huber_cost(double norm) {
    return norm < kHuber ? 0.5 * norm * norm : kHuber * (norm - 0.5 * kHuber);
}

// J (3, 6) of a residual by a right perturbation of T_odom_cam, rotation first: J_point [hat(p), -1].
SEAMARK_INLINE void by_pose(const double J_point[3][3], const double* p, double out[3][6]) {
    for (int k = 0; k < 3; ++k) {
        const double *J = J_point[k], x = p[0], y = p[1], z = p[2];
        out[k][0] = J[1] * z - J[2] * y;
        out[k][1] = J[2] * x - J[0] * z;
        out[k][2] = J[0] * y - J[1] * x;
        for (int j = 0; j < 3; ++j) out[k][3 + j] = -J[j];
    }
}

// p = R^T (point - t) for T_odom_cam (4, 4).
SEAMARK_INLINE void into_camera(const double* T, const double* point, double* p) {
    const double d[3] = {point[0] - T[3], point[1] - T[7], point[2] - T[11]};
    for (int j = 0; j < 3; ++j) p[j] = T[j] * d[0] + T[4 + j] * d[1] + T[8 + j] * d[2];
}

// T <- T * (exp(delta[:3]), delta[3:]).
inline void retract(double* T, const double* delta) {
    const double x = delta[0], y = delta[1], z = delta[2], square = x * x + y * y + z * z, angle = std::sqrt(square);
    const double a = angle < 1e-8 ? 1 : std::sin(angle) / angle;
    const double b = angle < 1e-8 ? 0.5 : (1 - std::cos(angle)) / square;
    const double E[3][3] = {{1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y},
                            {b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x},
                            {b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)}};
    for (int i = 0; i < 3; ++i) {
        double* row = T + 4 * i;
        const double old[3] = {row[0], row[1], row[2]};
        for (int j = 0; j < 3; ++j) {
            row[j] = old[0] * E[0][j] + old[1] * E[1][j] + old[2] * E[2][j];
            row[3] += old[j] * delta[3 + j];
        }
    }
}

}  // namespace seamark
