#include "pose.hpp"

#include <algorithm>
#include <cstring>

#include "linear.hpp"

namespace seamark {
namespace {

// Whitens pixel rows whose covariance is 1 + shift shift^T, shift being what one sigma of distance does to the pixel.
SEAMARK_INLINE void discount(const double* T, const Landmarks& landmarks, int64_t i, const double* in_cam,
                             Residual& at) {
    double origin[3], along[3], shift[2];
    into_camera(T, landmarks.origin, origin);
    for (int j = 0; j < 3; ++j) along[j] = (in_cam[j] - origin[j]) * landmarks.spread[i];
    for (int k = 0; k < 2; ++k) shift[k] = at.J[k][0] * along[0] + at.J[k][1] * along[1] + at.J[k][2] * along[2];
    const double square = shift[0] * shift[0] + shift[1] * shift[1];
    if (!(square > 1e-12)) return;
    const double share = (1 - 1 / std::sqrt(1 + square)) / square;
    const double off = (shift[0] * at.r[0] + shift[1] * at.r[1]) * share;
    double columns[3];
    for (int j = 0; j < 3; ++j) columns[j] = (shift[0] * at.J[0][j] + shift[1] * at.J[1][j]) * share;
    for (int k = 0; k < 2; ++k) {
        at.r[k] -= shift[k] * off;
        for (int j = 0; j < 3; ++j) at.J[k][j] -= shift[k] * columns[j];
    }
}

}  // namespace

SEAMARK_CLONES bool refine_pose(double* T, const Landmarks& landmarks, const Seen& seen, const Lens& lens,
                                const Expected& expected, int iterations, double converged, double* H,
                                double* errors) {
    for (int iteration = 0; iteration < iterations; ++iteration) {
        double gradient[6] = {}, upper[6][6] = {};
        for (int64_t i = 0; i < seen.n; ++i) {
            double p[3], J[3][6];
            Residual at;
            into_camera(T, landmarks.positions + 3 * i, p);
            p[2] = std::max(p[2], 1e-3);
            observe(p, seen, i, lens, at);
            if (landmarks.spread) discount(T, landmarks, i, p, at);
            by_pose(at.J, p, J);
            errors[i] = std::sqrt(at.r[0] * at.r[0] + at.r[1] * at.r[1]);
            const double of_pixel = huber_weight(errors[i]), weight[3] = {of_pixel, of_pixel,
                                                                          huber_weight(std::fabs(at.r[2]))};
            for (int k = 0; k < 3; ++k)
                for (int a = 0; a < 6; ++a) {
                    const double weighted = weight[k] * J[k][a];
                    gradient[a] += weighted * at.r[k];
                    for (int b = 0; b < 6; ++b) upper[a][b] += weighted * J[k][b];
                }
        }
        for (int a = 0; a < 6; ++a) {
            for (int b = 0; b < 6; ++b) H[6 * a + b] = a <= b ? upper[a][b] : upper[b][a];
            H[7 * a] += 1e-9;
        }
        if (expected.position) {
            const double certainty = 1 / (expected.sigma_m * expected.sigma_m);
            double off[3];
            into_camera(T, expected.position, off);
            for (int j = 0; j < 3; ++j) {
                gradient[3 + j] -= certainty * off[j];
                H[7 * (3 + j)] += certainty;
            }
        }
        double matrix[36], delta[6], length = 0;
        std::memcpy(matrix, H, sizeof matrix);
        for (int a = 0; a < 6; ++a) delta[a] = -gradient[a];
        if (!solve(matrix, 6, 6, delta)) return false;
        retract(T, delta);
        for (int a = 0; a < 6; ++a) length += delta[a] * delta[a];
        if (length < converged * converged) break;
    }
    return true;
}

SEAMARK_CLONES void pixel_errors(const double* T, const Landmarks& landmarks, const Seen& seen, const Lens& lens,
                                 double nearest_m, double* errors, bool* in_front) {
    for (int64_t i = 0; i < seen.n; ++i) {
        double p[3];
        Residual at;
        into_camera(T, landmarks.positions + 3 * i, p);
        in_front[i] = p[2] > nearest_m;
        if (!in_front[i]) p[0] = p[1] = 0, p[2] = 1;
        observe(p, seen, i, lens, at);
        if (landmarks.spread) discount(T, landmarks, i, p, at);
        errors[i] = std::sqrt(at.r[0] * at.r[0] + at.r[1] * at.r[1]);
    }
}

}  // namespace seamark
