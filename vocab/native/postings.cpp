#include "postings.hpp"

#include <algorithm>
#include <cstdlib>
#include <limits>
#include <new>
#include <numeric>

namespace seamark {

Block own(std::shared_ptr<BlockArrays> arrays, int64_t n_places) {
    Block block{n_places, arrays->starts.data(), arrays->ids.data(), arrays->codes.data(), nullptr, nullptr, arrays};
    if (!arrays->signatures.empty()) block.signatures = arrays->signatures.data();
    if (!arrays->geometry.empty()) block.geometry = arrays->geometry.data();
    return block;
}

Postings::Postings(int64_t n_words, int64_t block_places, bool with_signatures, bool with_geometry,
                   const std::array<float, kCodes>& code_weights, const std::array<float, kCodes>& code_shares,
                   const Kernels& kernels)
    : n_words_(n_words),
      block_places_(block_places),
      with_signatures_(with_signatures),
      with_geometry_(with_geometry),
      code_weights_(code_weights),
      code_shares_(code_shares),
      kernels_(kernels),
      head_(n_words, with_signatures, with_geometry) {}

int64_t Postings::add(const PlaceView& place, float mass) {
    const std::lock_guard writing(writer_);
    if (head_.n_places() == block_places_) {
        Block full = freeze_head();  // readers go on meanwhile
        const std::unique_lock change(state_);
        sealed_.push_back(std::move(full));
        head_.clear();
    }
    const std::unique_lock change(state_);
    if (head_.n_places() == 0 && !sealed_.empty() && sealed_.back().n_places < block_places_) {
        head_.refill(sealed_.back());  // the last block of a file grows on
        sealed_.pop_back();
    }
    head_.add(place);
    masses_.push_back(mass);
    live_.push_back(1);
    ++n_live_;
    return static_cast<int64_t>(masses_.size()) - 1;
}

bool Postings::remove(int64_t slot) {
    const std::lock_guard writing(writer_);
    const std::unique_lock change(state_);
    if (slot < 0 || slot >= static_cast<int64_t>(live_.size()) || !live_[static_cast<size_t>(slot)]) return false;
    live_[static_cast<size_t>(slot)] = 0;
    masses_[static_cast<size_t>(slot)] = std::numeric_limits<float>::infinity();
    --n_live_;
    return true;
}

std::vector<int32_t> Postings::compact() {
    const std::lock_guard writing(writer_);
    std::vector<int32_t> kept, rank(live_.size(), -1);
    std::vector<float> masses;
    for (size_t slot = 0; slot < live_.size(); ++slot) {
        if (!live_[slot]) continue;
        rank[slot] = static_cast<int32_t>(kept.size());
        kept.push_back(static_cast<int32_t>(slot));
        masses.push_back(masses_[slot]);
    }
    std::vector<Block> from = sealed_, fresh;
    if (head_.n_places()) from.push_back(freeze_head());
    const auto n = static_cast<int64_t>(kept.size());
    for (int64_t first = 0; first < n; first += block_places_)
        fresh.push_back(gather(first, std::min(block_places_, n - first), rank, from));
    const std::unique_lock change(state_);
    sealed_ = std::move(fresh);
    head_.clear();
    masses_ = std::move(masses);
    live_.assign(kept.size(), 1);
    return kept;
}

Block Postings::gather(int64_t first, int64_t n, const std::vector<int32_t>& rank,
                       const std::vector<Block>& from) const {
    auto arrays = std::make_shared<BlockArrays>();
    arrays->starts.push_back(0);
    for (int64_t l = 0; l < 2 * n_words_; ++l) {
        int64_t base = 0;
        for (const Block& block : from) {
            const ListView list = SealedLists{block, n_words_}.list(l);
            for (int64_t i = 0; i < list.n; ++i) {
                const int64_t id = rank[static_cast<size_t>(base + list.ids[i])] - first;
                if (id < 0 || id >= n) continue;  // removed, or in another of the new blocks
                arrays->ids.push_back(static_cast<uint16_t>(id));
                if (list.codes) arrays->codes.push_back(list.codes[i]);
                if (list.signatures) arrays->signatures.push_back(list.signatures[i]);
                if (list.geometry) arrays->geometry.push_back(list.geometry[i]);
            }
            base += block.n_places;
        }
        arrays->starts.push_back(static_cast<uint32_t>(arrays->ids.size()));
    }
    return own(std::move(arrays), n);
}

Block Postings::freeze_head() const {
    auto arrays = std::make_shared<BlockArrays>();
    arrays->starts.reserve(static_cast<size_t>(2 * n_words_ + 1));
    arrays->starts.push_back(0);
    uint32_t total = 0;
    for (int64_t l = 0; l < 2 * n_words_; ++l)
        arrays->starts.push_back(total += static_cast<uint32_t>(head_.list(l).n));
    arrays->ids.reserve(total);
    if (with_signatures_) arrays->signatures.reserve(total);
    if (with_geometry_) arrays->geometry.reserve(total);
    for (int64_t l = 0; l < 2 * n_words_; ++l) {
        const ListView list = head_.list(l);
        arrays->ids.insert(arrays->ids.end(), list.ids, list.ids + list.n);
        if (list.codes) arrays->codes.insert(arrays->codes.end(), list.codes, list.codes + list.n);
        if (list.signatures)
            arrays->signatures.insert(arrays->signatures.end(), list.signatures, list.signatures + list.n);
        if (list.geometry) arrays->geometry.insert(arrays->geometry.end(), list.geometry, list.geometry + list.n);
    }
    return own(std::move(arrays), head_.n_places());
}

Snapshot Postings::snapshot() const {
    const std::shared_lock reading(state_);
    Snapshot now{sealed_, masses_, live_};
    if (head_.n_places()) now.blocks.push_back(freeze_head());
    return now;
}

void Postings::attach(Snapshot snapshot) {
    const std::lock_guard writing(writer_);
    const std::unique_lock change(state_);
    sealed_ = std::move(snapshot.blocks);
    head_.clear();
    masses_ = std::move(snapshot.masses);
    live_ = std::move(snapshot.live);
    n_live_ = std::count(live_.begin(), live_.end(), uint8_t{1});
}

int64_t Postings::n_slots() const {
    const std::shared_lock reading(state_);
    return static_cast<int64_t>(masses_.size());
}

int64_t Postings::n_live() const {
    const std::shared_lock reading(state_);
    return n_live_;
}

size_t Postings::bytes() const {
    const std::shared_lock reading(state_);
    size_t total = head_.n_places() ? head_.bytes() : 0;
    for (const Block& block : sealed_) {
        const size_t n = block.starts[2 * n_words_];
        total += static_cast<size_t>(2 * n_words_ + 1) * 4 + n * 2 + (n - block.starts[n_words_]);
        total += (block.signatures ? n * 8 : 0) + (block.geometry ? n * 2 : 0);
    }
    return total;
}

std::vector<int32_t> top(const float* scores, int64_t n, int64_t k) {
    k = std::min(k, n);
    const auto better = [scores](int32_t a, int32_t b) {
        return scores[a] != scores[b] ? scores[a] > scores[b] : a < b;
    };
    std::vector<int32_t> best(static_cast<size_t>(k));  // a heap whose front is the worst
    if (k == 0) return best;
    std::iota(best.begin(), best.end(), 0);
    std::make_heap(best.begin(), best.end(), better);
    float threshold = scores[best.front()];
    for (int64_t slot = k; slot < n; ++slot) {
        if (!(scores[slot] > threshold)) continue;
        std::pop_heap(best.begin(), best.end(), better);
        best.back() = static_cast<int32_t>(slot);
        std::push_heap(best.begin(), best.end(), better);
        threshold = scores[best.front()];
    }
    std::sort_heap(best.begin(), best.end(), better);
    return best;
}

}  // namespace seamark
