#include "pose.hpp"

#include <algorithm>
#include <cstring>

#include "linear.hpp"

namespace seamark {
namespace {

constexpr int kRounds = 2;      // the inliers of a refined pose are others
constexpr int kPolarSteps = 3;  // each squares the error

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

// Refines T (4, 4) by at most `iterations` robust Gauss-Newton steps. Writes the normal matrix H (6, 6) of the last
// step and the whitened pixel error (N,) before it. Returns false when the landmarks do not determine the pose.
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

// Writes the whitened pixel error (N,) of landmarks seen from T (4, 4), less what their spread explains, and whether
// they are at least `nearest_m` in front; those that are not are taken for the point (0, 0, 1) of the camera.
SEAMARK_CLONES void pixel_errors(const double* T, const Landmarks& landmarks, const Seen& seen, const Lens& lens,
                                 double nearest_m, double* errors, char* in_front) {
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

// Observations of some landmarks, side by side.
struct Selected {
    std::vector<double> positions, pixels, inverse_depth, inverse_sigma, spread;
    Landmarks landmarks;
    Seen seen;

    void take(const Landmarks& from, const Seen& of, const std::vector<char>& which) {
        positions.clear(), pixels.clear(), inverse_depth.clear(), inverse_sigma.clear(), spread.clear();
        for (int64_t i = 0; i < of.n; ++i) {
            if (!which[i]) continue;
            positions.insert(positions.end(), from.positions + 3 * i, from.positions + 3 * i + 3);
            pixels.insert(pixels.end(), of.pixels + 2 * i, of.pixels + 2 * i + 2);
            inverse_depth.push_back(of.inverse_depth[i]), inverse_sigma.push_back(of.inverse_sigma[i]);
            if (from.spread) spread.push_back(from.spread[i]);
        }
        landmarks = {positions.data(), from.spread ? spread.data() : nullptr, from.origin};
        seen = {static_cast<int64_t>(inverse_depth.size()), pixels.data(), inverse_depth.data(), inverse_sigma.data()};
    }
};

// The mean of the two in the middle where their number is even.
double median(std::vector<double>& values) {
    const size_t half = values.size() / 2;
    std::nth_element(values.begin(), values.begin() + half, values.end());
    if (values.size() % 2) return values[half];
    return 0.5 * (values[half] + *std::max_element(values.begin(), values.begin() + half));
}

// Newton's iteration for the rotation nearest to that of T, as in frontend/se3.py.
void orthonormalise(double* T) {
    for (int step = 0; step < kPolarSteps; ++step) {
        double fix[3][3], R[3][3];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                fix[i][j] = (i == j ? 1.5 : 0) - 0.5 * (T[i] * T[j] + T[4 + i] * T[4 + j] + T[8 + i] * T[8 + j]);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                R[i][j] = T[4 * i] * fix[0][j] + T[4 * i + 1] * fix[1][j] + T[4 * i + 2] * fix[2][j];
        for (int i = 0; i < 3; ++i) std::copy(R[i], R[i] + 3, T + 4 * i);
    }
}

}  // namespace

bool converge(const Landmarks& landmarks, const Seen& seen, const double* votes, const PoseSettings& settings,
              ConvergedPose& state) {
    Selected chosen;
    std::vector<double> errors(seen.n), some;
    std::vector<char> before, in_front(seen.n);
    for (int round = 0; round < kRounds; ++round) {
        chosen.take(landmarks, seen, state.inliers);
        if (chosen.seen.n < settings.minimum) return false;
        some.resize(chosen.seen.n);
        if (!refine_pose(state.T, chosen.landmarks, chosen.seen, settings.lens, settings.expected, settings.iterations,
                         settings.converged, state.H, some.data()))
            return false;
        state.noise = median(some);
        orthonormalise(state.T);
        pixel_errors(state.T, landmarks, seen, settings.lens, settings.nearest_m, errors.data(), in_front.data());
        before = state.inliers;
        int64_t n = 0;
        for (int64_t i = 0; i < seen.n; ++i) {
            errors[i] *= settings.lens.pixel_sigma;
            n += state.inliers[i] = in_front[i] && errors[i] < settings.threshold_px;
        }
        if (n < settings.minimum) return false;
        if (before == state.inliers) break;
    }
    some.clear();
    state.score = 0;
    for (int64_t i = 0; i < seen.n; ++i) {
        state.score += votes[i] * (state.inliers[i] ? errors[i] : settings.threshold_px);
        if (state.inliers[i]) some.push_back(errors[i]);
    }
    state.error_px = median(some);
    return true;
}

}  // namespace seamark
