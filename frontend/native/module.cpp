// What Python sees: seamark.frontend._native. Arrays are checked here for type and shape; nothing here holds the
// interpreter while it computes.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "corners.hpp"
#include "flow.hpp"
#include "patches.hpp"
#include "pose.hpp"
#include "pyramid.hpp"
#include "sift.hpp"
#include "window.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace seamark {
namespace {

template <class T, long... Shape>
using In = nb::ndarray<const T, nb::shape<Shape...>, nb::c_contig, nb::device::cpu>;
template <class T, long... Shape>
using Out = nb::ndarray<nb::numpy, T, nb::shape<Shape...>>;
using Grey = In<uint8_t, -1, -1>;
using Pixels = In<float, -1, 2>;

void require(bool condition, const char* what) {
    if (!condition) throw std::invalid_argument(what);
}

template <class T, long... Shape>
Out<T, Shape...> give(std::vector<T> values, std::initializer_list<size_t> shape) {
    auto* kept = new std::vector<T>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
    return Out<T, Shape...>(kept->data(), shape, owner);
}

using Aligned = std::tuple<Out<float, -1, 2>, Out<float, -1>>;

template <class Align, class Hints>
Aligned aligned(Align align, const Pyramid& source, const Pyramid& target, const Pixels& points, const Pixels& start,
                const Hints& hints) {
    const size_t n = points.shape(0);
    require(start.shape(0) == n && hints.shape(0) == n, "each point needs a start and a direction or warp");
    std::vector<float> there(start.data(), start.data() + 2 * n), correlations(n);
    {
        nb::gil_scoped_release free;
        align(source[0], target[0], points.data(), hints.data(), static_cast<int64_t>(n), there.data(), correlations.data());
    }
    return {give<float, -1, 2>(std::move(there), {n, 2}), give<float, -1>(std::move(correlations), {n})};
}

void make_pyramid(Pyramid* self, const Grey& grey, int levels) {
    require(levels >= 0 && levels <= 8, "a pyramid has 0 to 8 reduced levels");
    require(grey.shape(0) > 0 && grey.shape(1) > 0, "an image needs pixels");
    require(grey.shape(0) < 32768 && grey.shape(1) < 32768, "an image has less than 32768 rows and columns");
    nb::gil_scoped_release free;
    new (self) Pyramid(grey.data(), static_cast<int>(grey.shape(1)), static_cast<int>(grey.shape(0)), levels);
}

// A view, whose owner is the pyramid.
nb::ndarray<nb::numpy, const uint8_t, nb::ndim<2>> level_of(const Pyramid& pyramid, int level) {
    require(level >= 0 && level <= pyramid.top(), "a pyramid has no such level");
    const Level& of = pyramid[level];
    return {of.pixels, {static_cast<size_t>(of.height), static_cast<size_t>(of.width)}, nb::find(&pyramid), {of.stride, 1}};
}

using Rows = nb::ndarray<const uint8_t, nb::ndim<2>, nb::device::cpu>;

Level level_with(const Rows& image) {
    require(image.shape(0) > 0 && image.shape(1) > 0, "an image needs pixels");
    require(image.shape(0) < 32768 && image.shape(1) < 32768, "an image has less than 32768 rows and columns");
    require(image.stride(1) == 1 && image.stride(0) >= 0, "the pixels of a row lie side by side");
    return {image.data(), image.stride(0), static_cast<int>(image.shape(1)), static_cast<int>(image.shape(0))};
}

std::tuple<Out<int32_t, -1, 2>, Out<float, -1>> strongest_of(const Rows& image, int cell, int border, float harris_k,
                                                             const std::optional<Grey>& mask) {
    const Level grey = level_with(image);
    require(cell > 0 && border >= 3, "a grid has cells, and corners lie 3 pixels inside at least");
    require(!mask || (static_cast<int>(mask->shape(0)) == grey.height && static_cast<int>(mask->shape(1)) == grey.width),
            "a mask has the size of its image");
    const Grid grid = {cell, grey.height / cell, grey.width / cell, border};
    const size_t n = static_cast<size_t>(grid.rows) * grid.columns;
    std::vector<float> strength(n);
    std::vector<int32_t> pixels(2 * n);
    if (std::min(grey.height, grey.width) > 2 * border) {
        nb::gil_scoped_release free;
        strongest(grey, grid, harris_k, mask ? mask->data() : nullptr, strength.data(), pixels.data());
    }
    return {give<int32_t, -1, 2>(std::move(pixels), {n, 2}), give<float, -1>(std::move(strength), {n})};
}

using Flags = nb::ndarray<nb::numpy, bool, nb::shape<-1>>;

Flags give_flags(bool* flags, size_t n) {
    nb::capsule owner(flags, [](void* p) noexcept { delete[] static_cast<bool*>(p); });
    return Flags(flags, {n}, owner);
}

Flags apart_from(const Pixels& points, const Pixels& others, float distance, bool to_each_other) {
    const size_t n = points.shape(0);
    auto* flags = new bool[n];
    apart(points.data(), static_cast<int64_t>(n), others.data(), static_cast<int64_t>(others.shape(0)), distance,
          to_each_other, flags);
    return give_flags(flags, n);
}

const FlowKernels& flow_kernels_named(const std::optional<std::string>& level) {
    const FlowKernels* chosen = nullptr;
    for (const FlowKernels* const* each = flow_levels(); *each; ++each)
        if (!level || *level == (*each)->name) chosen = *each;
    if (!chosen) throw std::invalid_argument("this processor has no level " + *level);
    return *chosen;
}

std::vector<std::string> levels() {
    std::vector<std::string> names;
    for (const FlowKernels* const* each = flow_levels(); *each; ++each) names.emplace_back((*each)->name);
    return names;
}

std::tuple<Out<float, -1, 2>, Out<float, -1>, Out<float, -1>> followed(
    const Pyramid& before, const Pyramid& after, const Pixels& points, const Pixels& start, int side, int top,
    int back_top, const std::optional<std::string>& level, bool level_out, float least_likeness,
    float reach) {
    const size_t n = points.shape(0);
    require(start.shape(0) == n, "each point needs a start");
    require(side >= 5 && side <= kMaxSide && side % 2 == 1, "the side of a patch is odd, from 5 to 29");
    const FlowKernels& kernels = flow_kernels_named(level);
    std::vector<float> there(start.data(), start.data() + 2 * n), round_trip(n), likeness(n);
    {
        nb::gil_scoped_release free;
        follow(before, after, points.data(), static_cast<int64_t>(n), {side / 2, top, back_top, level_out, least_likeness, reach}, kernels, there.data(),
               round_trip.data(), likeness.data());
    }
    return {give<float, -1, 2>(std::move(there), {n, 2}), give<float, -1>(std::move(round_trip), {n}),
            give<float, -1>(std::move(likeness), {n})};
}

using Vector = In<double, -1>;
using Points = In<double, -1, 3>;
using Pose = In<double, 4, 4>;
using Four = std::tuple<double, double, double, double>;

Lens lens_of(const Four& camera, double pixel_sigma) {
    return {std::get<0>(camera), std::get<1>(camera), std::get<2>(camera), std::get<3>(camera), pixel_sigma};
}

Seen seen_of(const In<double, -1, 2>& pixels, const Vector& inverse_depth, const Vector& inverse_sigma, size_t n) {
    require(pixels.shape(0) == n && inverse_depth.shape(0) == n && inverse_sigma.shape(0) == n,
            "each observation needs a pixel, an inverse depth and its sigma");
    return {static_cast<int64_t>(n), pixels.data(), inverse_depth.data(), inverse_sigma.data()};
}

Landmarks landmarks_of(const Points& positions, const std::optional<Vector>& spread,
                       const std::optional<In<double, 3>>& origin) {
    require(!spread || (origin && spread->shape(0) == positions.shape(0)), "a spread is that of a distance from an origin");
    return {positions.data(), spread ? spread->data() : nullptr, spread ? origin->data() : nullptr};
}

using Mask = nb::ndarray<const bool, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Converged = std::tuple<Out<double, 4, 4>, Out<double, 6, 6>, Flags, double, double, double>;

std::optional<Converged> converged_from(
    const Pose& T, const Mask& inliers, const Points& positions, const In<double, -1, 2>& pixels,
    const Vector& inverse_depth, const Vector& inverse_sigma, const std::optional<Vector>& spread,
    const std::optional<In<double, 3>>& origin, const Vector& votes, const Four& camera, double pixel_sigma,
    const std::optional<In<double, 3>>& expected, double sigma_m, double threshold_px, double nearest_m,
    int64_t minimum, int iterations, double least_step) {
    const size_t n = positions.shape(0);
    const Seen seen = seen_of(pixels, inverse_depth, inverse_sigma, n);
    const Landmarks landmarks = landmarks_of(positions, spread, origin);
    require(inliers.shape(0) == n && votes.shape(0) == n, "each landmark is an inlier or not, and has a vote");
    require(minimum > 0, "a pose needs landmarks");
    const PoseSettings settings = {lens_of(camera, pixel_sigma), {expected ? expected->data() : nullptr, sigma_m},
                                   threshold_px, nearest_m, minimum, iterations, least_step};
    ConvergedPose pose;
    std::copy(T.data(), T.data() + 16, pose.T);
    pose.inliers.assign(inliers.data(), inliers.data() + n);
    {
        nb::gil_scoped_release free;
        if (!converge(landmarks, seen, votes.data(), settings, pose)) return std::nullopt;
    }
    auto* flags = new bool[n];
    std::copy(pose.inliers.begin(), pose.inliers.end(), flags);
    return Converged(give<double, 4, 4>(std::vector<double>(pose.T, pose.T + 16), {4, 4}),
                     give<double, 6, 6>(std::vector<double>(pose.H, pose.H + 36), {6, 6}), give_flags(flags, n),
                     pose.noise, pose.error_px, pose.score);
}

std::tuple<Out<float, -1, 5>, Out<uint8_t, -1, kDescriptor>> sift_of(const Rows& image, const std::optional<Grey>& mask,
                                                                     int64_t most, float contrast, RightOfWay* way) {
    const Level level = level_with(image);
    require(!mask || (mask->shape(0) == image.shape(0) && mask->shape(1) == image.shape(1)), "a mask has the size of its image");
    require(most > 0, "key points are asked for");
    KeyPoints found;
    {
        nb::gil_scoped_release free;
        RightOfWay nobody;
        found = sift(level, mask ? mask->data() : nullptr, most, contrast, way ? *way : nobody);
    }
    const size_t n = found.table.size() / 5;
    return {give<float, -1, 5>(std::move(found.table), {n, 5}),
            give<uint8_t, -1, kDescriptor>(std::move(found.descriptors), {n, kDescriptor})};
}

void check(const Bundle& bundle, const In<int64_t, -1>& keyframe_of, const In<int64_t, -1>& landmark_of) {
    const size_t n = bundle.seen.n;
    require(keyframe_of.shape(0) == n && landmark_of.shape(0) == n, "each observation needs a keyframe and a landmark");
    require(bundle.n_fixed >= 0 && bundle.n_fixed <= bundle.n_poses, "n_fixed is a number of poses");
    for (size_t i = 0; i < n; ++i) {
        const int64_t k = bundle.keyframe_of[i], l = bundle.landmark_of[i];
        require(k >= 0 && k < bundle.n_poses, "keyframe_of names poses");
        require(l >= 0 && l < bundle.n_landmarks && (i == 0 || l >= bundle.landmark_of[i - 1]),
                "landmark_of names landmarks in ascending order");
    }
}

std::tuple<Out<double, -1, 4, 4>, Out<double, -1, 3>, Out<double, -1>, Out<double, -1, 3, 3>, double, double> adjusted(
    const In<double, -1, 4, 4>& poses, int64_t n_fixed, const Points& landmarks, const In<int64_t, -1>& keyframe_of,
    const In<int64_t, -1>& landmark_of, const In<double, -1, 2>& pixels, const Vector& inverse_depth,
    const Vector& inverse_sigma, const Four& camera, double pixel_sigma, double offset, double offset_information,
    int iterations, double damping, double least_decrease) {
    const size_t n_poses = poses.shape(0), n_landmarks = landmarks.shape(0), n = pixels.shape(0);
    const Bundle bundle = {static_cast<int64_t>(n_poses),
                           n_fixed,
                           static_cast<int64_t>(n_landmarks),
                           keyframe_of.data(),
                           landmark_of.data(),
                           seen_of(pixels, inverse_depth, inverse_sigma, n),
                           lens_of(camera, pixel_sigma),
                           offset,
                           offset_information};
    check(bundle, keyframe_of, landmark_of);
    Adjusted state;
    state.poses.assign(poses.data(), poses.data() + 16 * n_poses);
    state.landmarks.assign(landmarks.data(), landmarks.data() + 3 * n_landmarks);
    state.offset = offset;
    {
        nb::gil_scoped_release free;
        adjust(bundle, iterations, damping, least_decrease, state);
    }
    return {give<double, -1, 4, 4>(std::move(state.poses), {n_poses, 4, 4}),
            give<double, -1, 3>(std::move(state.landmarks), {n_landmarks, 3}),
            give<double, -1>(std::move(state.errors), {n}),
            give<double, -1, 3, 3>(std::move(state.covariances), {n_landmarks, 3, 3}),
            state.offset,
            state.depth_information};
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Kernels of the front end; seamark.frontend.patches, pose and window are their users' side.";
    m.def("levels", &levels);
    nb::class_<Pyramid>(m, "Pyramid")
        .def("__init__", &make_pyramid, "grey"_a.noconvert(), "levels"_a)
        .def_prop_ro("top", &Pyramid::top)
        .def_prop_ro("grey", [](const Pyramid& self) { return level_of(self, 0); })
        .def("level", &level_of, "level"_a);
    m.def("follow", &followed, "before"_a, "after"_a, "points"_a, "start"_a, "side"_a, "top"_a, "back_top"_a,
          "level"_a = nb::none(), "level_out"_a = true, "least_likeness"_a = -1.0f,
          "reach"_a = std::numeric_limits<float>::infinity());
    m.def("strongest", &strongest_of, "image"_a.noconvert(), "cell"_a, "border"_a, "harris_k"_a, "mask"_a.noconvert().none());
    m.def("median_difference", [](const Rows& image) { return median_difference(level_with(image)); },
          "image"_a.noconvert());
    nb::class_<RightOfWay>(m, "RightOfWay")
        .def(nb::init<>())
        .def_prop_ro("taken", &RightOfWay::taken)
        .def("take", &RightOfWay::take)
        .def("give_back", &RightOfWay::give_back);
    m.def("sift", &sift_of, "image"_a.noconvert(), "mask"_a.noconvert().none(), "most"_a, "contrast"_a, "way"_a.none() = nb::none());
    m.def("apart", &apart_from, "points"_a, "others"_a, "distance"_a, "to_each_other"_a);
    m.def(
        "align_along",
        [](const Pyramid& source, const Pyramid& target, const Pixels& points, const Pixels& start,
           const Pixels& along) {
            return aligned(align_along, source, target, points, start, along);
        },
        "source"_a, "target"_a, "points"_a, "start"_a, "directions"_a);
    m.def(
        "align_warped",
        [](const Pyramid& source, const Pyramid& target, const Pixels& points, const Pixels& start,
           const In<float, -1, 2, 2>& unwarp) { return aligned(align_warped, source, target, points, start, unwarp); },
        "source"_a, "target"_a, "points"_a, "start"_a, "unwarp"_a);
    m.def("converge", &converged_from, "T_odom_cam"_a, "inliers"_a, "landmarks"_a, "pixels"_a, "inverse_depth"_a,
          "inverse_sigma"_a, "spread"_a.none(), "origin"_a.none(), "votes"_a, "camera"_a, "pixel_sigma"_a,
          "expected"_a.none(), "sigma_m"_a, "threshold_px"_a, "nearest_m"_a, "minimum"_a, "iterations"_a,
          "least_step"_a);
    m.def("adjust", &adjusted, "poses"_a, "n_fixed"_a, "landmarks"_a, "keyframe_of"_a, "landmark_of"_a, "pixels"_a,
          "inverse_depth"_a, "inverse_sigma"_a, "camera"_a, "pixel_sigma"_a, "offset"_a, "offset_information"_a,
          "iterations"_a, "damping"_a, "least_decrease"_a);
}

}  // namespace seamark
