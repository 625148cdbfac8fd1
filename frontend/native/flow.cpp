// The slopes are those of the patch that is sought, computed once per point and level (Bouguet 2001). If wanted its mean
// is taken off (Baker and Matthews 2004): then a change of brightness does not pull, and what the mean says is lost. Nothing beyond the border of either image does: only pixels
// that lie in both with all that their interpolation and slopes need are compared.
#include "flow.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace seamark {
namespace {

constexpr double kUnit = static_cast<double>(kGreyUnit) * kGreyUnit;
constexpr double kLeastCurvature = 0.1;    // mean squared slope in the weakest direction, (grey levels per pixel)^2
constexpr double kLeastVariance = 0.25;    // of the grey levels of a patch that can be compared
constexpr double kLeastShare = 0.2;        // of a patch that must be inside: a corner of the image leaves a quarter
constexpr double kPreciseStep = 0.003, kCoarseStep = 0.03;  // steps that end the search, in pixels of the level
constexpr int kPreciseSteps = 30, kCoarseSteps = 10;

struct Point {
    float x, y;
};

// Columns and rows of a patch, the first and the one after the last.
struct Range {
    int left, right, top, bottom;

    bool operator==(const Range& b) const {
        return left == b.left && right == b.right && top == b.top && bottom == b.bottom;
    }
};

float distance(Point a, Point b) { return std::sqrt((a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y)); }

bool inside(const Level& level, Point p) {
    return p.x >= 0 && p.y >= 0 && p.x < static_cast<float>(level.width) && p.y < static_cast<float>(level.height);
}

// One patch of one image, sought in another.
class Search {
public:
    Search(const Level& from, const Level& to, Point of, const FlowSettings& settings, const FlowKernels& kernels,
           Template& model)
        : to_(to), half_(settings.half), side_(2 * half_ + 1), level_out_(settings.level_out), kernels_(kernels),
          model_(model) {
        int x, y;
        const Spot spot = spot_of(from, of, x, y);
        kernels.read(spot, side_, model_);
        readable_ = {std::max(0, 1 - x), std::min(side_, from.width - 2 - x), std::max(0, 1 - y),
                     std::min(side_, from.height - 2 - y)};
    }

    // Moves a point that is inside to where the patch is; returns false when it runs out of the image or of reach, or is not held.
    bool find(Point& there, double least_step, int steps, float reach) {
        const Point begin = there;
        double last_x = 0, last_y = 0;
        for (int k = 0; k < steps; ++k) {
            int64_t sums[3];
            const Spot spot = look(there);
            if (!held_) return false;
            kernels_.mismatch(model_, spot, region_, sums);
            const double off = level_out_ ? sums[2] / pixels_ : 0, bx = sums[0] - off * slope_x_, by = sums[1] - off * slope_y_;
            const double step_x = (xy_ * by - yy_ * bx) / determinant_, step_y = (xy_ * bx - xx_ * by) / determinant_;
            there.x += static_cast<float>(step_x), there.y += static_cast<float>(step_y);
            if (!inside(to_, there) || distance(there, begin) > reach) return false;
            if (step_x * step_x + step_y * step_y < least_step * least_step) return true;
            if (std::fabs(step_x + last_x) < 0.01 && std::fabs(step_y + last_y) < 0.01 && k > 0) {  // to and fro
                there.x -= static_cast<float>(0.5 * step_x), there.y -= static_cast<float>(0.5 * step_y);
                return true;
            }
            last_x = step_x, last_y = step_y;
        }
        return true;
    }

    // Returns the zero-mean normalised correlation at a point, 0 where there is nothing to compare.
    float likeness(Point there) {
        const Spot spot = look(there);
        if (!held_) return 0;
        int64_t sums[5];
        kernels_.likeness(model_, spot, region_, sums);
        const double m = sums[0] / pixels_, p = sums[1] / pixels_;
        const double mm = sums[2] / pixels_ - m * m, mp = sums[3] / pixels_ - m * p, pp = sums[4] / pixels_ - p * p;
        const double least = kLeastVariance * kUnit;
        return static_cast<float>(mp / std::sqrt(std::max(mm, least) * std::max(pp, least)));
    }

private:
    // Returns where the patch around a point is read and the pixel (x, y) it begins in.
    Spot spot_of(const Level& level, Point p, int& x, int& y) const {
        const int left = static_cast<int>(p.x), top = static_cast<int>(p.y);  // points inside are not negative
        x = left - half_, y = top - half_;
        return {level.pixels + level.stride * y + x, level.stride,
                static_cast<int16_t>((p.x - static_cast<float>(left)) * kPixelUnit),
                static_cast<int16_t>((p.y - static_cast<float>(top)) * kPixelUnit)};
    }

    // Prepares the comparison at a point; the curvature changes only where another part of the patch is inside.
    Spot look(Point there) {
        int x, y;
        const Spot spot = spot_of(to_, there, x, y);
        const Range range = {std::max(readable_.left, -x), std::min(readable_.right, to_.width - 1 - x),
                             std::max(readable_.top, -y), std::min(readable_.bottom, to_.height - 1 - y)};
        if (looked_ && range == range_) return spot;
        looked_ = true, range_ = range;
        held_ = range.left < range.right && range.top < range.bottom;
        if (held_) compare(range);
        return spot;
    }

    void compare(const Range& range) {
        for (int i = 0; i < kLanes; ++i) region_.columns[i] = i >= range.left && i < range.right ? -1 : 0;
        region_.top = range.top, region_.bottom = range.bottom;
        pixels_ = static_cast<double>(range.right - range.left) * (range.bottom - range.top);
        int64_t sums[5];
        kernels_.curvature(model_, region_, sums);
        slope_x_ = level_out_ ? static_cast<double>(sums[3]) : 0, slope_y_ = level_out_ ? static_cast<double>(sums[4]) : 0;
        xx_ = sums[0] - slope_x_ * slope_x_ / pixels_;
        xy_ = sums[1] - slope_x_ * slope_y_ / pixels_;
        yy_ = sums[2] - slope_y_ * slope_y_ / pixels_;
        determinant_ = xx_ * yy_ - xy_ * xy_;
        const double weakest = 0.5 * (xx_ + yy_ - std::sqrt((xx_ - yy_) * (xx_ - yy_) + 4 * xy_ * xy_));
        held_ = pixels_ >= kLeastShare * side_ * side_ && weakest > kLeastCurvature * kUnit * pixels_ && determinant_ > 0;
    }

    const Level& to_;
    const int half_, side_;
    const bool level_out_;
    const FlowKernels& kernels_;
    Template& model_;
    Range readable_, range_;
    Region region_;
    bool looked_ = false, held_ = false;
    double pixels_, slope_x_, slope_y_, xx_, xy_, yy_, determinant_;
};

// Seeks a patch from the coarsest level down. A level that fails leaves the point where it was, the finest loses it.
bool descend(const Pyramid& from, const Pyramid& to, Point of, Point& there, int top, const FlowSettings& settings,
             const FlowKernels& kernels, Template& model, float* likeness) {
    if (!inside(from[0], of) || !inside(to[0], there)) return false;
    for (int level = std::min({top, from.top(), to.top()}); level >= 0; --level) {
        const float scale = 1.0f / static_cast<float>(1 << level);
        Point at = {there.x * scale, there.y * scale};
        const Point begin = {of.x * scale, of.y * scale};
        const bool finest = level == 0;
        Search search(from[level], to[level], begin, settings, kernels, model);
        const bool precise = finest && likeness;
        const bool found = search.find(at, precise ? kPreciseStep : kCoarseStep, precise ? kPreciseSteps : kCoarseSteps,
                                       settings.reach * scale);
        if (!found && finest) return false;
        if (found) there = {at.x / scale, at.y / scale};
        if (precise) *likeness = search.likeness(at);
    }
    return true;
}

}  // namespace

const FlowKernels* const* flow_levels() {
    static const FlowKernels* levels[4] = {nullptr, nullptr, nullptr, nullptr};
    static const bool found = [] {
        int n = 0;
        levels[n++] = &kFlowBaseline;
#if defined(SEAMARK_X86_LEVELS)
        __builtin_cpu_init();
        if (__builtin_cpu_supports("avx2")) levels[n++] = &kFlowAvx2;
        if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw")) levels[n++] = &kFlowAvx512;
#endif
        return true;
    }();
    (void)found;
    return levels;
}

void follow(const Pyramid& before, const Pyramid& after, const float* points, int64_t n, const FlowSettings& settings,
            const FlowKernels& kernels, float* there, float* round_trip, float* likeness) {
    Template model;
    for (int64_t i = 0; i < n; ++i, points += 2, there += 2) {
        const Point begin = {points[0], points[1]};
        Point end = {there[0], there[1]}, back = begin;
        round_trip[i] = std::numeric_limits<float>::infinity();
        likeness[i] = 0;
        if (!descend(before, after, begin, end, settings.top, settings, kernels, model, likeness + i)) continue;
        there[0] = end.x, there[1] = end.y;
        if (likeness[i] < settings.least_likeness) continue;  // another patch: no matter where it came from
        if (!descend(after, before, end, back, settings.back_top, settings, kernels, model, nullptr)) continue;
        round_trip[i] = distance(back, begin);
    }
}

}  // namespace seamark
