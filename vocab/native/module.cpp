// What Python sees: seamark.vocab._native. Arrays are checked here for shape, type and range; sentences for the user are
// the matter of the Python that calls.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

#include "matching.hpp"
#include "postings.hpp"
#include "quantiser.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace seamark {
namespace {

template <class T>
using In = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Descriptors = nb::ndarray<const uint8_t, nb::shape<-1, kDescriptorSize>, nb::c_contig, nb::device::cpu>;
template <class T, class... Shape>
using Out = nb::ndarray<nb::numpy, T, Shape...>;

const Kernels& kernels_named(const std::optional<std::string>& level) {
    const Kernels* chosen = nullptr;
    for (const Kernels* const* each = available_levels(); *each; ++each)
        if (!level || *level == (*each)->name) chosen = *each;
    if (!chosen) throw std::invalid_argument("this processor has no level " + *level);
    return *chosen;
}

std::vector<std::string> levels() {
    std::vector<std::string> names;
    for (const Kernels* const* each = available_levels(); *each; ++each) names.emplace_back((*each)->name);
    return names;
}

void require(bool condition, const char* what) {
    if (!condition) throw std::invalid_argument(what);
}

template <class T, class... Shape>
Out<T, Shape...> give(std::vector<T> values, std::initializer_list<size_t> shape) {
    auto* kept = new std::vector<T>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
    return Out<T, Shape...>(kept->data(), shape, owner);
}

Quantiser make_quantiser(const Descriptors& words, const Descriptors& coarse, const In<int64_t>& offsets,
                         const std::optional<std::string>& level) {
    std::vector<int64_t> bounds(offsets.data(), offsets.data() + offsets.shape(0));
    require(bounds.size() >= 2 && bounds.front() == 0 && bounds.back() == static_cast<int64_t>(words.shape(0)) &&
                std::is_sorted(bounds.begin(), bounds.end()) && words.shape(0) < (size_t{1} << 31),
            "offsets must rise from 0 to the number of words");
    require(bounds.size() == 2 || coarse.shape(0) == bounds.size() - 1, "each cell needs a centre");
    const Kernels& kernels = kernels_named(level);
    nb::gil_scoped_release free;
    return Quantiser(words.data(), coarse.data(), std::move(bounds), kernels);
}

std::tuple<Out<int32_t, nb::ndim<2>>, Out<int32_t, nb::ndim<2>>> assign(const Quantiser& quantiser,
                                                                        const Descriptors& descriptors, int k,
                                                                        int beam, int32_t reach) {
    require(k >= 1 && beam >= 1 && reach >= 0, "k and beam must be at least 1, reach at least 0");
    const size_t n = descriptors.shape(0);
    std::vector<int32_t> words(n * static_cast<size_t>(k)), distances(words.size());
    {
        nb::gil_scoped_release free;
        std::vector<Near> found(words.size());
        quantiser.assign(descriptors.data(), static_cast<int64_t>(n), k, beam, reach, found.data());
        for (size_t i = 0; i < found.size(); ++i) {
            words[i] = found[i].word;
            distances[i] = found[i].distance;
        }
    }
    const auto width = static_cast<size_t>(k);
    return {give<int32_t, nb::ndim<2>>(std::move(words), {n, width}),
            give<int32_t, nb::ndim<2>>(std::move(distances), {n, width})};
}

// (pairs, 4) int32: row, column, squared distance of the pair, and of the row to the column next after it.
Out<int32_t, nb::ndim<2>> mutual(const Descriptors& rows, const Descriptors& columns,
                                 const std::optional<std::string>& level) {
    require(columns.shape(0) >= 2, "at least two columns are needed");
    const Kernels& kernels = kernels_named(level);
    std::vector<int32_t> values;
    size_t n = 0;
    {
        nb::gil_scoped_release free;
        const std::vector<Pair> pairs = mutual_nearest(rows.data(), static_cast<int64_t>(rows.shape(0)), columns.data(),
                                                       static_cast<int64_t>(columns.shape(0)), kernels);
        n = pairs.size();
        values.reserve(4 * n);
        for (const Pair& pair : pairs) values.insert(values.end(), {pair.row, pair.column, pair.nearest, pair.next});
    }
    return give<int32_t, nb::ndim<2>>(std::move(values), {n, 4});
}

Out<uint8_t, nb::ndim<1>> similarity(const In<float>& x, const In<float>& y, const In<float>& to_x,
                                     const In<float>& to_y, const In<float>& log_scale, const In<float>& turn,
                                     float tolerance, float scale_step, float most_turn) {
    const size_t m = x.shape(0);
    for (const In<float>* each : {&y, &to_x, &to_y, &log_scale, &turn})
        require(each->shape(0) == m, "all arrays must be of one length");
    const Matches matches{x.data(), y.data(), to_x.data(), to_y.data(), log_scale.data(), turn.data(),
                          static_cast<int64_t>(m)};
    std::vector<uint8_t> marks;
    {
        nb::gil_scoped_release free;
        marks = best_similarity(matches, tolerance, scale_step, most_turn);
    }
    return give<uint8_t, nb::ndim<1>>(std::move(marks), {m});
}

void require_words(const In<int32_t>& words, int64_t n_words) {
    for (size_t i = 0; i < words.shape(0); ++i)
        require(words.data()[i] >= 0 && words.data()[i] < n_words, "a word is not in the vocabulary");
}

template <class T>
const T* column(const std::optional<In<T>>& array, bool wanted, size_t n, const char* what) {
    require(array.has_value() == wanted && (!wanted || array->shape(0) == n), what);
    return wanted ? array->data() : nullptr;
}

int64_t add(Postings& postings, const In<int32_t>& words, const In<uint8_t>& codes, float mass,
            const std::optional<In<uint64_t>>& signatures, const std::optional<In<uint16_t>>& geometry) {
    const size_t n = words.shape(0);
    require_words(words, postings.n_words());
    require(codes.shape(0) == n, "each word needs a code");
    const PlaceView place{words.data(), codes.data(),
                          column(signatures, postings.with_signatures(), n, "signatures as the index has them"),
                          column(geometry, postings.with_geometry(), n, "geometry as the index has it"),
                          static_cast<int64_t>(n)};
    nb::gil_scoped_release free;
    return postings.add(place, mass);
}

Out<float, nb::ndim<1>> give_scores(Scores scores) {
    const auto n = static_cast<size_t>(scores.n);
    float* values = scores.values.release();
    nb::capsule owner(values, [](void* p) noexcept { Scores::Free{}(static_cast<float*>(p)); });
    return Out<float, nb::ndim<1>>(values, {n}, owner);
}

Out<float, nb::ndim<1>> votes(const Postings& postings, const In<int32_t>& words, const In<float>& weights,
                              const In<float>& most, float mass) {
    const size_t n = words.shape(0);
    require_words(words, postings.n_words());
    require(weights.shape(0) == n && most.shape(0) == n, "each word needs a weight and a most");
    const QueryView query{words.data(), weights.data(), most.data(), mass, nullptr, nullptr, static_cast<int64_t>(n)};
    Scores scores;
    {
        nb::gil_scoped_release free;
        scores = postings.votes(query);
    }
    return give_scores(std::move(scores));
}

Out<float, nb::ndim<1>> near_votes(const Postings& postings, const In<int32_t>& words, const In<float>& weights,
                                   float mass, const In<uint64_t>& signatures, const In<float>& table,
                                   const std::optional<In<uint16_t>>& geometry) {
    const size_t n = words.shape(0);
    require_words(words, postings.n_words());
    require(weights.shape(0) == n && signatures.shape(0) == n, "each word needs a weight and a signature");
    require(table.shape(0) == kDistances, "the table must have a weight for each of 65 distances");
    require(postings.with_signatures(), "the index has no signatures");
    require(!geometry || postings.with_geometry(), "the index has no geometry");
    int limit = kDistances - 1;
    while (limit >= 0 && table.data()[limit] == 0.0f) --limit;
    const QueryView query{words.data(), weights.data(), nullptr, mass, signatures.data(),
                          column(geometry, geometry.has_value(), n, "each word needs geometry"),
                          static_cast<int64_t>(n)};
    Scores scores;
    {
        nb::gil_scoped_release free;
        scores = postings.near_votes(query, table.data(), limit, geometry.has_value());
    }
    return give_scores(std::move(scores));
}

template <class T>
nb::object view(const T* values, size_t n, const std::shared_ptr<const void>& owner) {
    if (!values) return nb::none();
    auto* kept = new std::shared_ptr<const void>(owner);
    nb::capsule capsule(kept, [](void* p) noexcept { delete static_cast<std::shared_ptr<const void>*>(p); });
    return nb::cast(Out<const T, nb::ndim<1>>(values, {n}, capsule));
}

nb::tuple snapshot(const Postings& postings) {
    Snapshot now;
    {
        nb::gil_scoped_release free;
        now = postings.snapshot();
    }
    nb::list blocks;
    const auto n_lists = static_cast<size_t>(2 * postings.n_words());
    for (const Block& block : now.blocks) {
        const size_t n = block.starts[n_lists], n_plain = block.starts[n_lists / 2];
        blocks.append(nb::make_tuple(block.n_places, view(block.starts, n_lists + 1, block.owner),
                                     view(block.ids, n, block.owner), view(block.codes, n - n_plain, block.owner),
                                     view(block.signatures, n, block.owner), view(block.geometry, n, block.owner)));
    }
    const size_t n_slots = now.masses.size();
    return nb::make_tuple(blocks, give<float, nb::ndim<1>>(std::move(now.masses), {n_slots}),
                          give<uint8_t, nb::ndim<1>>(std::move(now.live), {n_slots}));
}

using BlockIn = std::tuple<int64_t, In<uint32_t>, In<uint16_t>, In<uint8_t>, std::optional<In<uint64_t>>,
                           std::optional<In<uint16_t>>>;

// Only what memory safety needs is checked of the arrays: that they are as long as they say and starts never fall.
Block attached(const BlockIn& in, const Postings& postings) {
    const auto& [n_places, starts, ids, codes, signatures, geometry] = in;
    const auto n_lists = static_cast<size_t>(2 * postings.n_words());
    require(n_places >= 1 && n_places <= postings.block_places(), "a block has too many places or none");
    require(starts.shape(0) == n_lists + 1 && starts.data()[0] == 0 &&
                std::is_sorted(starts.data(), starts.data() + n_lists + 1) && starts.data()[n_lists] == ids.shape(0) &&
                ids.shape(0) - starts.data()[n_lists / 2] == codes.shape(0),
            "the lists of a block do not fit its postings");
    Block block{n_places,
                starts.data(),
                ids.data(),
                codes.data(),
                column(signatures, postings.with_signatures(), ids.shape(0), "signatures as the index has them"),
                column(geometry, postings.with_geometry(), ids.shape(0), "geometry as the index has it"),
                nullptr};
    // The last reader of a block may be a thread without the interpreter's lock.
    block.owner = std::shared_ptr<const void>(new BlockIn(in), [](const void* p) {
        nb::gil_scoped_acquire lock;
        delete static_cast<const BlockIn*>(p);
    });
    return block;
}

void attach(Postings& postings, const std::vector<BlockIn>& blocks, const In<float>& masses, const In<uint8_t>& live) {
    Snapshot snapshot;
    snapshot.masses.assign(masses.data(), masses.data() + masses.shape(0));
    for (size_t slot = 0; slot < live.shape(0); ++slot) snapshot.live.push_back(live.data()[slot] != 0);
    int64_t n_places = 0;
    for (const BlockIn& block : blocks) {
        snapshot.blocks.push_back(attached(block, postings));
        n_places += snapshot.blocks.back().n_places;
    }
    require(n_places == static_cast<int64_t>(masses.shape(0)) && masses.shape(0) == live.shape(0),
            "each place needs a mass");
    nb::gil_scoped_release free;
    postings.attach(std::move(snapshot));
}

Postings* make_postings(int64_t n_words, const In<float>& code_weights, const In<float>& code_shares,
                        int64_t block_places, bool with_signatures, bool with_geometry,
                        const std::optional<std::string>& level) {
    require(n_words >= 1 && n_words < (int64_t{1} << 30), "an index needs words");
    require(code_weights.shape(0) == kCodes && code_shares.shape(0) == kCodes, "256 codes need weights and shares");
    require(block_places >= 1 && block_places <= kMostPlaces, "a block holds 1 to 65536 places");
    std::array<float, kCodes> weights, shares;
    std::copy_n(code_weights.data(), kCodes, weights.begin());
    std::copy_n(code_shares.data(), kCodes, shares.begin());
    return new Postings(n_words, block_places, with_signatures, with_geometry, weights, shares, kernels_named(level));
}

}  // namespace
}  // namespace seamark

NB_MODULE(_native, m) {
    using namespace seamark;
    m.doc() = "Kernels of the vocabulary: nearest words and posting lists. The GIL is released in all of them.";
    m.def("levels", &levels);

    m.def("mutual", &mutual, "rows"_a, "columns"_a, "level"_a = nb::none());
    m.def("similarity", &similarity, "x"_a, "y"_a, "to_x"_a, "to_y"_a, "log_scale"_a, "turn"_a, "tolerance"_a,
          "scale_step"_a, "most_turn"_a);

    nb::class_<Quantiser>(m, "Quantiser")
        .def("__init__",
             [](Quantiser* self, const Descriptors& words, const Descriptors& coarse, const In<int64_t>& offsets,
                const std::optional<std::string>& level) {
                 new (self) Quantiser(make_quantiser(words, coarse, offsets, level));
             },
             "words"_a, "coarse"_a, "offsets"_a, "level"_a = nb::none())
        .def_prop_ro("level", [](const Quantiser& self) { return self.kernels().name; })
        .def("assign", &assign, "descriptors"_a, "k"_a = 1, "beam"_a = 1, "reach"_a = 0x7fffffff);

    nb::class_<Postings>(m, "Postings")
        .def(nb::new_(&make_postings), "n_words"_a, "code_weights"_a, "code_shares"_a, "block_places"_a = kMostPlaces,
             "with_signatures"_a = false, "with_geometry"_a = false, "level"_a = nb::none())
        .def("add", &add, "words"_a, "codes"_a, "mass"_a, "signatures"_a = nb::none(), "geometry"_a = nb::none())
        .def("remove", &Postings::remove, "slot"_a, nb::call_guard<nb::gil_scoped_release>())
        .def("compact",
             [](Postings& self) {
                 std::vector<int32_t> kept;
                 {
                     nb::gil_scoped_release free;
                     kept = self.compact();
                 }
                 const size_t n = kept.size();
                 return give<int32_t, nb::ndim<1>>(std::move(kept), {n});
             })
        .def("votes", &votes, "words"_a, "weights"_a, "most"_a, "mass"_a)
        .def("near_votes", &near_votes, "words"_a, "weights"_a, "mass"_a, "signatures"_a, "table"_a, "geometry"_a = nb::none())
        .def("snapshot", &snapshot)
        .def("attach", &attach, "blocks"_a, "masses"_a, "live"_a)
        .def_prop_ro("n_slots", &Postings::n_slots)
        .def_prop_ro("n_live", &Postings::n_live)
        .def_prop_ro("n_bytes", &Postings::bytes);

    m.def(
        "top",
        [](const In<float>& scores, int64_t k) {
            require(k >= 0, "k must not be negative");
            std::vector<int32_t> best;
            {
                nb::gil_scoped_release free;
                best = top(scores.data(), static_cast<int64_t>(scores.shape(0)), k);
            }
            const size_t n = best.size();
            return give<int32_t, nb::ndim<1>>(std::move(best), {n});
        },
        "scores"_a, "k"_a);
}
