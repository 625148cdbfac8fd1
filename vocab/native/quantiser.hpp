// The nearest words of descriptors, exactly or through a coarse level of cells.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "kernels.hpp"

namespace seamark {

struct Near {
    int32_t distance;  // squared
    int32_t word;
    bool operator<(const Near& other) const {
        return distance != other.distance ? distance < other.distance : word < other.word;
    }
};

// The sum of the squares of a descriptor's 128 bytes.
int32_t square(const uint8_t* descriptor);

// Descriptors of 128 bytes laid out in groups of sixteen, filled up with words that are never nearest.
class Grouped {
public:
    void reserve_groups(int64_t n_groups);
    // Appends words and returns the first of their groups.
    int64_t append(const uint8_t* words, int64_t n);
    int64_t n_groups() const { return n_groups_; }
    const uint8_t* bytes(int64_t group) const { return bytes_.get() + group * kGroupBytes; }
    const int32_t* bias(int64_t group) const { return bias_.data() + group * kGroup; }

private:
    struct Free {
        void operator()(uint8_t* bytes) const;
    };
    std::unique_ptr<uint8_t[], Free> bytes_;
    std::vector<int32_t> bias_;
    int64_t n_groups_ = 0, capacity_ = 0;
};

// Words in cells: those of cell c are offsets[c]..offsets[c + 1] and lie around coarse centre c. With one cell no coarse
// level is asked and the search is exact. Immutable, so any number of threads may use it.
class Quantiser {
public:
    Quantiser(const uint8_t* words, const uint8_t* coarse, std::vector<int64_t> offsets, const Kernels& kernels);

    // Finds for each of n descriptors the k nearest words of the `beam` nearest cells, nearest first, the lower word of
    // equally near ones; cells whose centre is farther than the nearest by more than `reach`, in squared distance, are
    // left out. Where the cells hold fewer words, the word is -1.
    void assign(const uint8_t* descriptors, int64_t n, int k, int beam, int32_t reach, Near* out) const;

    const Kernels& kernels() const { return kernels_; }

private:
    void assign_some(const uint8_t* descriptors, int64_t n, int k, int beam, int32_t reach, Near* out) const;
    void search(const Grouped& grouped, int64_t first_group, int64_t n_words, int32_t first_word,
                const uint8_t* descriptors, const int32_t* which, int64_t n, int k, int32_t reach, Near* out,
                std::vector<int32_t>& scratch) const;

    const Kernels& kernels_;
    std::vector<int64_t> offsets_;
    std::vector<int64_t> first_group_;
    Grouped words_, coarse_;
};

}  // namespace seamark
