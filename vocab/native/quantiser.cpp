#include "quantiser.hpp"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <new>
#include <numeric>

namespace seamark {
namespace {

constexpr int32_t kNever = std::numeric_limits<int32_t>::max() / 2;  // 2 sum w (d - 128) cannot overflow it
constexpr int32_t kAnywhere = std::numeric_limits<int32_t>::max();
constexpr int64_t kBatch = 16384;                                    // descriptors that are sorted by cell at a time

// Keeps the k nearest in order; `out` is full of candidates or of words -1, which are farther than any.
void insert(Near candidate, int k, Near* out) {
    if (!(candidate < out[k - 1])) return;
    int at = k - 1;
    for (; at > 0 && candidate < out[at - 1]; --at) out[at] = out[at - 1];
    out[at] = candidate;
}

}  // namespace

int32_t square(const uint8_t* descriptor) {
    int32_t sum = 0;
    for (int j = 0; j < kDescriptorSize; ++j) sum += descriptor[j] * descriptor[j];
    return sum;
}

void Grouped::Free::operator()(uint8_t* bytes) const { std::free(bytes); }

void Grouped::reserve_groups(int64_t n_groups) {
    if (n_groups <= capacity_) return;
    auto* fresh = static_cast<uint8_t*>(std::aligned_alloc(64, static_cast<size_t>(n_groups) * kGroupBytes));
    if (!fresh) throw std::bad_alloc();
    if (n_groups_) std::memcpy(fresh, bytes_.get(), static_cast<size_t>(n_groups_) * kGroupBytes);
    bytes_.reset(fresh);
    capacity_ = n_groups;
}

int64_t Grouped::append(const uint8_t* words, int64_t n) {
    const int64_t first = n_groups_;
    const int64_t more = (n + kGroup - 1) / kGroup;
    if (first + more > capacity_) reserve_groups(std::max(first + more, capacity_ * 2));
    std::memset(bytes_.get() + first * kGroupBytes, 0, static_cast<size_t>(more) * kGroupBytes);
    bias_.resize(static_cast<size_t>(first + more) * kGroup, kNever);
    for (int64_t i = 0; i < n; ++i) {
        const uint8_t* word = words + i * kDescriptorSize;
        uint8_t* group = bytes_.get() + (first + i / kGroup) * kGroupBytes + 4 * (i % kGroup);
        for (int c = 0; c < kDescriptorSize / 4; ++c) std::memcpy(group + c * 4 * kGroup, word + 4 * c, 4);
        const int32_t sum = std::accumulate(word, word + kDescriptorSize, 0);
        bias_[static_cast<size_t>(first * kGroup + i)] = square(word) - 256 * sum;
    }
    n_groups_ = first + more;
    return first;
}

Quantiser::Quantiser(const uint8_t* words, const uint8_t* coarse, std::vector<int64_t> offsets, const Kernels& kernels)
    : kernels_(kernels), offsets_(std::move(offsets)) {
    const auto n_cells = static_cast<int64_t>(offsets_.size()) - 1;
    int64_t n_groups = 0;
    for (int64_t c = 0; c < n_cells; ++c)
        n_groups += (offsets_[c + 1] - offsets_[c] + kGroup - 1) / kGroup;
    words_.reserve_groups(n_groups);
    for (int64_t c = 0; c < n_cells; ++c)
        first_group_.push_back(words_.append(words + offsets_[c] * kDescriptorSize, offsets_[c + 1] - offsets_[c]));
    if (n_cells > 1) coarse_.append(coarse, n_cells);
}

void Quantiser::assign(const uint8_t* descriptors, int64_t n, int k, int beam, int32_t reach, Near* out) const {
    for (int64_t start = 0; start < n; start += kBatch)
        assign_some(descriptors + start * kDescriptorSize, std::min(kBatch, n - start), k, beam, reach, out + start * k);
}

void Quantiser::assign_some(const uint8_t* descriptors, int64_t n, int k, int beam, int32_t reach, Near* out) const {
    const auto n_cells = static_cast<int64_t>(offsets_.size()) - 1;
    beam = static_cast<int>(std::min<int64_t>(beam, n_cells));
    std::fill(out, out + n * k, Near{std::numeric_limits<int32_t>::max(), -1});
    std::vector<int32_t> scratch, which(static_cast<size_t>(n));
    std::iota(which.begin(), which.end(), 0);
    if (n_cells == 1) {
        search(words_, 0, offsets_[1], 0, descriptors, which.data(), n, k, kAnywhere, out, scratch);
    } else {
        std::vector<Near> cells(static_cast<size_t>(n) * beam, Near{std::numeric_limits<int32_t>::max(), -1});
        search(coarse_, 0, n_cells, 0, descriptors, which.data(), n, beam, reach, cells.data(), scratch);
        const auto near = [&](size_t i) {
            const size_t nearest = i / static_cast<size_t>(beam) * static_cast<size_t>(beam);
            return cells[i].word >= 0 && int64_t{cells[i].distance} - cells[nearest].distance <= reach;
        };
        // Sort the descriptors by cell, so that the words of a cell are read once for all of them.
        std::vector<int64_t> start(static_cast<size_t>(n_cells) + 1, 0);
        for (size_t i = 0; i < cells.size(); ++i)
            if (near(i)) ++start[static_cast<size_t>(cells[i].word) + 1];
        std::partial_sum(start.begin(), start.end(), start.begin());
        std::vector<int32_t> sorted(static_cast<size_t>(start.back()));
        std::vector<int64_t> next(start.begin(), start.end() - 1);
        for (size_t i = 0; i < cells.size(); ++i)
            if (near(i))
                sorted[static_cast<size_t>(next[static_cast<size_t>(cells[i].word)]++)] =
                    static_cast<int32_t>(i / static_cast<size_t>(beam));
        for (int64_t c = 0; c < n_cells; ++c)
            search(words_, first_group_[c], offsets_[c + 1] - offsets_[c], static_cast<int32_t>(offsets_[c]),
                   descriptors, sorted.data() + start[c], start[c + 1] - start[c], k, kAnywhere, out, scratch);
    }
    for (int64_t i = 0; i < n; ++i) {
        const int32_t own = square(descriptors + i * kDescriptorSize);
        for (int j = 0; j < k; ++j)
            if (out[i * k + j].word >= 0) out[i * k + j].distance += own;
    }
}

void Quantiser::search(const Grouped& grouped, int64_t first_group, int64_t n_words, int32_t first_word,
                       const uint8_t* descriptors, const int32_t* which, int64_t n, int k, int32_t reach, Near* out,
                       std::vector<int32_t>& scratch) const {
    constexpr int64_t kWidth = kMostGroups * kGroup;  // words that all descriptors are compared with before the next ones
    scratch.resize(static_cast<size_t>(kTile * kWidth));
    int32_t positions[kWidth + 16];
    for (int64_t from = 0; from < n_words; from += kWidth) {
        const int64_t width = std::min(kWidth, n_words - from), group = first_group + from / kGroup;
        const auto word = static_cast<int32_t>(first_word + from);
        for (int64_t i = 0; i < n; i += kTile) {
            const int m = static_cast<int>(std::min<int64_t>(kTile, n - i));
            const uint8_t* tile[kTile];
            for (int j = 0; j < m; ++j) tile[j] = descriptors + static_cast<int64_t>(which[i + j]) * kDescriptorSize;
            const int64_t n_groups = (width + kGroup - 1) / kGroup;
            if (k == 1) {
                int32_t value[kTile], at[kTile];
                kernels_.nearest(grouped.bytes(group), grouped.bias(group), n_groups, tile, m, value, at);
                for (int j = 0; j < m; ++j) insert({value[j], word + at[j]}, 1, out + which[i + j]);
                continue;
            }
            kernels_.distances(grouped.bytes(group), grouped.bias(group), n_groups, tile, m, scratch.data(), kWidth);
            for (int j = 0; j < m; ++j) {
                const int32_t* row = scratch.data() + j * kWidth;
                Near* best = out + static_cast<int64_t>(which[i + j]) * k;
                const int64_t farthest = int64_t{row[kernels_.smallest(row, width)]} + reach;
                const auto limit = static_cast<int32_t>(std::min<int64_t>(farthest, best[k - 1].distance));
                const int64_t found = kernels_.at_most(row, width, limit, positions);
                for (int64_t p = 0; p < found; ++p) insert({row[positions[p]], word + positions[p]}, k, best);
            }
        }
    }
}

}  // namespace seamark
