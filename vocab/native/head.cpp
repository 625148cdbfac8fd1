#include <algorithm>

#include "postings.hpp"

namespace seamark {
namespace {

constexpr uint32_t kSmallest = 2;

int logarithm(uint32_t size) { return 31 - __builtin_clz(size); }

template <class T>
void move(LargeVector<T>& array, uint32_t from, uint32_t to, uint32_t n) {
    std::copy_n(array.begin() + from, n, array.begin() + to);
}

}  // namespace

Head::Head(int64_t n_words, bool with_signatures, bool with_geometry)
    : n_words_(n_words),
      with_signatures_(with_signatures),
      with_geometry_(with_geometry),
      extents_(static_cast<size_t>(2 * n_words)) {}

void Head::add(const PlaceView& place) {
    const auto id = static_cast<uint16_t>(n_places_);
    for (int64_t i = 0; i < place.n; ++i) {
        if (i + 8 < place.n) prefetch_header(place.words[i + 8] + (place.codes[i + 8] == 1 ? 0 : n_words_));
        append(place.words[i] + (place.codes[i] == 1 ? 0 : n_words_), id, place.codes[i],
               with_signatures_ ? place.signatures[i] : 0, with_geometry_ ? place.geometry[i] : uint16_t{0});
    }
    ++n_places_;
}

void Head::refill(const Block& block) {
    clear();
    const int64_t n_plain = block.starts[n_words_];
    for (int64_t l = 0; l < 2 * n_words_; ++l)
        for (int64_t i = block.starts[l]; i < block.starts[l + 1]; ++i)
            append(l, block.ids[i], l < n_words_ ? uint8_t{1} : block.codes[i - n_plain],
                   with_signatures_ ? block.signatures[i] : 0, with_geometry_ ? block.geometry[i] : uint16_t{0});
    n_places_ = block.n_places;
}

void Head::clear() {
    extents_.assign(extents_.size(), Extent{});
    pools_ = {};
    n_places_ = 0;
}

ListView Head::list(int64_t l) const {
    const Extent extent = extents_[static_cast<size_t>(l)];
    const bool coded = l >= n_words_;
    const Pool& pool = pools_[coded];
    return {pool.ids.data() + extent.start, coded ? pool.codes.data() + extent.start : nullptr,
            with_signatures_ ? pool.signatures.data() + extent.start : nullptr,
            with_geometry_ ? pool.geometry.data() + extent.start : nullptr, extent.count};
}

size_t Head::bytes() const {
    size_t total = extents_.size() * sizeof(Extent);
    for (const Pool& pool : pools_)
        total += pool.ids.size() * 2 + pool.codes.size() + pool.signatures.size() * 8 + pool.geometry.size() * 2;
    return total;
}

void Head::append(int64_t l, uint16_t id, uint8_t code, uint64_t signature, uint16_t geometry) {
    const bool coded = l >= n_words_;
    Pool& pool = pools_[coded];
    Extent& extent = extents_[static_cast<size_t>(l)];
    const bool full = extent.count == 0 || (extent.count >= kSmallest && (extent.count & (extent.count - 1)) == 0);
    if (full) {
        const uint32_t size = extent.count ? 2 * extent.count : kSmallest;
        const uint32_t start = take(pool, coded, size);
        if (extent.count) {
            move(pool.ids, extent.start, start, extent.count);
            if (coded) move(pool.codes, extent.start, start, extent.count);
            if (with_signatures_) move(pool.signatures, extent.start, start, extent.count);
            if (with_geometry_) move(pool.geometry, extent.start, start, extent.count);
            pool.free[static_cast<size_t>(logarithm(extent.count))].push_back(extent.start);
        }
        extent.start = start;
    }
    const uint32_t at = extent.start + extent.count++;
    pool.ids[at] = id;
    if (coded) pool.codes[at] = code;
    if (with_signatures_) pool.signatures[at] = signature;
    if (with_geometry_) pool.geometry[at] = geometry;
}

uint32_t Head::take(Pool& pool, bool coded, uint32_t size) {
    auto& free = pool.free[static_cast<size_t>(logarithm(size))];
    if (!free.empty()) {
        const uint32_t start = free.back();
        free.pop_back();
        return start;
    }
    const uint32_t start = pool.used;
    pool.used += size;
    pool.ids.resize(pool.used);
    if (coded) pool.codes.resize(pool.used);
    if (with_signatures_) pool.signatures.resize(pool.used);
    if (with_geometry_) pool.geometry.resize(pool.used);
    return start;
}

}  // namespace seamark
