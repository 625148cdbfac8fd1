// Votes: what a query adds up over the posting lists.
#include <algorithm>
#include <cstdlib>
#include <limits>
#include <new>

#include "postings.hpp"

namespace seamark {
namespace {

constexpr int64_t kHeadersAhead = 32;  // words between the prefetch of where a list begins and the look at it
constexpr int64_t kLinesAhead = 48;    // cache lines between the prefetch of postings and their use
constexpr int64_t kLine = 64;

// Walks the lists of a query some lines ahead of the reader, one line for each that is read. Lists are short and far
// apart, so the processor's own prefetching ends where it would begin to pay.
class Scout {
public:
    Scout(const std::vector<ListView>& lists, bool signatures) : lists_(lists), signatures_(signatures) {
        for (int64_t line = 0; line < kLinesAhead; ++line) step();
    }
    void step() {
        while (next_ >= end_) {
            if (at_ == lists_.size()) return;
            const ListView& list = lists_[at_++];
            next_ = signatures_ ? reinterpret_cast<const char*>(list.signatures) : reinterpret_cast<const char*>(list.ids);
            end_ = next_ + list.n * (signatures_ ? 8 : 2);
        }
        __builtin_prefetch(next_);
        next_ += kLine;
    }

private:
    const std::vector<ListView>& lists_;
    const bool signatures_;
    size_t at_ = 0;
    const char* next_ = nullptr;
    const char* end_ = nullptr;
};

// Votes are summed over so many places at a time, because a first-level cache holds their sums: lists of ascending places
// are walked in step, a section of each after the other.
constexpr int64_t kSection = 8192;
constexpr size_t kListsAhead = 8;  // between the prefetch of a list's section and its use
constexpr size_t kCodedAhead = 32;  // the same for lists with codes; even, because every second list has them

struct Cursor {
    const uint16_t* at;
    const uint16_t* end;
    float weight;
    int32_t lines;  // of its postings in a section, on average
};

// Adds the postings of places below `bound` to the sums of their section. A damaged file may name any place; it is one
// of the section all the same.
void add_section(std::vector<Cursor>& lists, int32_t bound, float* sums) {
    for (size_t l = 0; l < lists.size(); ++l) {
        if (l + kListsAhead < lists.size()) {
            const Cursor& later = lists[l + kListsAhead];
            for (int32_t line = 0; line <= later.lines; ++line)
                __builtin_prefetch(reinterpret_cast<const char*>(later.at) + kLine * line);
        }
        const uint16_t* at = lists[l].at;
        const uint16_t* const end = lists[l].end;
        const float weight = lists[l].weight;
        for (; end - at >= 8 && at[7] < bound; at += 8)
            for (int j = 0; j < 8; ++j) sums[at[j] % kSection] += weight;
        for (; at != end && *at < bound; ++at) sums[*at % kSection] += weight;
        lists[l].at = at;
    }
}

// Adds a vote to the bin of the difference in orientation and to that of the difference in scale.
void count_geometry(int there, int here, float weight, float* bins) {
    const int turn = ((there & 255) - (here & 255) + 256 + 8) & 255;  // bins are centred on no turn
    const int growth = std::clamp(((there >> 8) - (here >> 8) + 8 + 128) >> 4, 0, kScaleBins - 1);
    bins[turn >> 4] += weight;
    bins[kOrientationBins + growth] += weight;
}

}  // namespace

template <class Lists>
void Postings::look_up(const Lists& lists, const QueryView& query, std::vector<ListView>& found) const {
    found.clear();
    for (int64_t i = 0; i < query.n; ++i) {
        if (i + kHeadersAhead < query.n) {
            lists.prefetch_header(query.words[i + kHeadersAhead]);
            lists.prefetch_header(query.words[i + kHeadersAhead] + n_words_);
        }
        found.push_back(lists.list(query.words[i]));
        found.push_back(lists.list(query.words[i] + n_words_));
    }
}

template <class Each>
void Postings::visit_blocks(const QueryView& query, Each each) const {
    std::vector<ListView> lists;
    lists.reserve(static_cast<size_t>(2 * query.n));
    int64_t first = 0;
    for (const Block& block : sealed_) {
        look_up(SealedLists{block, n_words_}, query, lists);
        each(first, block.n_places, lists);
        first += block.n_places;
    }
    if (head_.n_places()) {
        look_up(head_, query, lists);
        each(first, head_.n_places(), lists);
    }
}

Scores Postings::votes(const QueryView& query) const {
    const std::shared_lock reading(state_);
    Scores scores = room(1);
    const float mass = std::max(query.mass, std::numeric_limits<float>::min());
    std::vector<Cursor> plain;
    plain.reserve(static_cast<size_t>(query.n));
    visit_blocks(query, [&](int64_t first, int64_t n_places, const std::vector<ListView>& lists) {
        float* places = scores.values.get() + first;
        plain.clear();
        for (size_t l = 0; l < lists.size(); ++l) {
            const ListView& list = lists[l];
            const float weight = query.weights[l / 2], most = query.most[l / 2];
            if (l + kCodedAhead < lists.size() && list.codes) {
                __builtin_prefetch(lists[l + kCodedAhead].ids);
                __builtin_prefetch(lists[l + kCodedAhead].codes);
            }
            if (list.codes) {
                for (int64_t j = 0; j < list.n; ++j) {
                    const uint8_t code = list.codes[j];
                    places[list.ids[j]] += weight * (std::min(code_weights_[code], most) * code_shares_[code]);
                }
            } else if (list.n) {
                plain.push_back({list.ids, list.ids + list.n, weight * std::min(code_weights_[1], most),
                                 static_cast<int32_t>(2 * list.n * kSection / (n_places * kLine) + 1)});
            }
        }
        alignas(64) float sums[kSection];
        for (int64_t from = 0; from < n_places; from += kSection) {
            const int64_t n = std::min(kSection, n_places - from);
            float* section = places + from;
            std::copy_n(section, n, sums);
            add_section(plain, static_cast<int32_t>(from + kSection), sums);
            const float* masses = masses_.data() + first + from;
            for (int64_t i = 0; i < n; ++i) section[i] = std::min(1.0f, sums[i] / std::max(mass, masses[i]));
        }
    });
    return scores;
}

Scores Postings::near_votes(const QueryView& query, const float* table, int limit, bool geometric) const {
    constexpr int64_t kBins = kOrientationBins + kScaleBins;
    constexpr int64_t kPiece = 512;
    const std::shared_lock reading(state_);
    Scores total = room(geometric ? kBins : 1);
    std::array<uint32_t, kPiece> positions;
    std::array<uint8_t, kPiece> distances;
    visit_blocks(query, [&](int64_t first, int64_t, const std::vector<ListView>& lists) {
        Scout signatures(lists, true), ids(lists, false);
        for (size_t l = 0; l < lists.size(); ++l) {
            const ListView& list = lists[l];
            const size_t i = l / 2;
            for (int64_t from = 0; from < list.n; from += kPiece) {
                const int64_t n = std::min(kPiece, list.n - from);
                for (int64_t line = 0; line < n; line += kLine / 8) signatures.step();
                for (int64_t line = 0; line < n; line += kLine / 2) ids.step();
                const int64_t found = kernels_.near_signatures(list.signatures + from, n, query.signatures[i], limit,
                                                               positions.data(), distances.data());
                for (int64_t j = 0; j < found; ++j) {
                    const int64_t at = from + positions[static_cast<size_t>(j)];
                    const uint8_t code = list.codes ? list.codes[at] : uint8_t{1};
                    const float weight = query.weights[i] * code_weights_[code] * code_shares_[code] *
                                         table[distances[static_cast<size_t>(j)]];
                    const int64_t slot = first + list.ids[at];
                    if (geometric)
                        count_geometry(list.geometry[at], query.geometry[i], weight, total.values.get() + slot * kBins);
                    else
                        total.values[static_cast<size_t>(slot)] += weight;
                }
            }
        }
    });
    if (!geometric) return finished(std::move(total), query.mass);
    Scores scores = room(1);
    for (int64_t slot = 0; slot < scores.n; ++slot) {
        const float* bins = total.values.get() + slot * kBins;
        scores.values[static_cast<size_t>(slot)] = std::min(*std::max_element(bins, bins + kOrientationBins),
                                                            *std::max_element(bins + kOrientationBins, bins + kBins));
    }
    return finished(std::move(scores), query.mass);
}

Scores Postings::room(int64_t per_slot) const {
    const size_t n = masses_.size();
    auto* values = static_cast<float*>(std::calloc((n + kMostPlaces) * static_cast<size_t>(per_slot), sizeof(float)));
    if (!values) throw std::bad_alloc();
    return {std::unique_ptr<float[], Scores::Free>(values), static_cast<int64_t>(n)};
}

Scores Postings::finished(Scores scores, float mass) const {
    float* values = scores.values.get();
    mass = std::max(mass, std::numeric_limits<float>::min());
    for (size_t slot = 0; slot < masses_.size(); ++slot) values[slot] = std::min(1.0f, values[slot] / std::max(mass, masses_[slot]));
    return scores;
}

void Scores::Free::operator()(float* values) const { std::free(values); }

}  // namespace seamark
