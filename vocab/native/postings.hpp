// Posting lists: which places show a word, in blocks of places laid out for the memory bus.
//
// A place is a slot. A block holds up to 65,536 slots, so that a posting names its place by 16 bits. Each word has two
// lists per block: postings of code 1 (the word is seen once), which are an id and nothing else, and postings of other
// codes with a byte for the code. A code stands for a weight through a table. Signatures and geometry, where the index
// has them, lie beside the ids in arrays of their own.
//
// Blocks are immutable, but for the head, which grows by one place at a time. One thread may write while others read.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <mutex>
#include <shared_mutex>
#include <vector>

#include "kernels.hpp"
#include "large_pages.hpp"

namespace seamark {

constexpr int64_t kMostPlaces = 65536;  // of a block
constexpr int kCodes = 256;
constexpr int kDistances = 65;        // Hamming distances of 64 bits: 0..64
constexpr int kOrientationBins = 16;  // of the whole circle
constexpr int kScaleBins = 16;        // of 16 units each: the caller says what a unit is

// The postings of some place, sorted by word; several of one word may follow each other.
struct PlaceView {
    const int32_t* words;
    const uint8_t* codes;
    const uint64_t* signatures;  // nullptr where the index has none
    const uint16_t* geometry;    // orientation in the low byte, scale in the high one; nullptr where there is none
    int64_t n;
};

struct QueryView {
    const int32_t* words;
    const float* weights;
    const float* most;  // a posting counts at most so much, before the weight; nullptr where the signatures are asked
    float mass;         // the sum that a place would have that shows the same
    const uint64_t* signatures;
    const uint16_t* geometry;
    int64_t n;
};

// Lists in one run: list l, word + n_words for codes other than 1, is starts[l]..starts[l + 1]. `codes` begins with the
// first posting of list n_words.
struct Block {
    int64_t n_places = 0;
    const uint32_t* starts = nullptr;
    const uint16_t* ids = nullptr;
    const uint8_t* codes = nullptr;
    const uint64_t* signatures = nullptr;
    const uint16_t* geometry = nullptr;
    std::shared_ptr<const void> owner;  // of all these arrays
};

struct BlockArrays {
    LargeVector<uint32_t> starts;
    LargeVector<uint16_t> ids;
    LargeVector<uint8_t> codes;
    LargeVector<uint64_t> signatures;
    LargeVector<uint16_t> geometry;
};

Block own(std::shared_ptr<BlockArrays> arrays, int64_t n_places);

struct ListView {
    const uint16_t* ids;
    const uint8_t* codes;  // nullptr where every code is 1
    const uint64_t* signatures;
    const uint16_t* geometry;
    int64_t n;
};

// The lists of an immutable block.
struct SealedLists {
    const Block& block;
    int64_t n_words;

    ListView list(int64_t l) const {
        const uint32_t start = block.starts[l];
        return {block.ids + start, l >= n_words ? block.codes + (start - block.starts[n_words]) : nullptr,
                block.signatures ? block.signatures + start : nullptr,
                block.geometry ? block.geometry + start : nullptr, block.starts[l + 1] - start};
    }
    void prefetch_header(int64_t l) const { __builtin_prefetch(block.starts + l); }
};

// The block that grows: each list is an extent of a pool whose size is a power of two, moved when it is full.
class Head {
public:
    Head(int64_t n_words, bool with_signatures, bool with_geometry);
    void add(const PlaceView& place);
    void refill(const Block& block);
    void clear();
    ListView list(int64_t l) const;
    void prefetch_header(int64_t l) const { __builtin_prefetch(&extents_[static_cast<size_t>(l)]); }
    int64_t n_places() const { return n_places_; }
    size_t bytes() const;

private:
    struct Extent {
        uint32_t start = 0, count = 0;
    };
    struct Pool {
        LargeVector<uint16_t> ids;
        LargeVector<uint8_t> codes;
        LargeVector<uint64_t> signatures;
        LargeVector<uint16_t> geometry;
        std::array<std::vector<uint32_t>, 32> free;  // by the logarithm of the size
        uint32_t used = 0;
    };
    void append(int64_t l, uint16_t id, uint8_t code, uint64_t signature, uint16_t geometry);
    uint32_t take(Pool& pool, bool coded, uint32_t size);

    int64_t n_words_, n_places_ = 0;
    bool with_signatures_, with_geometry_;
    std::vector<Extent> extents_;
    std::array<Pool, 2> pools_;
};

// One number for each slot. The room behind them takes what a damaged file may name: any 16 bits are a place of a block.
struct Scores {
    struct Free {
        void operator()(float* values) const;
    };
    std::unique_ptr<float[], Free> values;
    int64_t n = 0;
};

// Everything there is at one moment, the head as a block among the others.
struct Snapshot {
    std::vector<Block> blocks;
    std::vector<float> masses;
    std::vector<uint8_t> live;
};

class Postings {
public:
    Postings(int64_t n_words, int64_t block_places, bool with_signatures, bool with_geometry,
             const std::array<float, kCodes>& code_weights, const std::array<float, kCodes>& code_shares,
             const Kernels& kernels);

    int64_t add(const PlaceView& place, float mass);  // returns its slot
    bool remove(int64_t slot);                         // false if there is none
    std::vector<int32_t> compact();                    // forgets removed places; returns the old slot of each new one

    // Returns for each slot the sum over common words of weight times the lesser of both counts, as the codes weigh them,
    // divided by the greater of both masses, at most 1.
    Scores votes(const QueryView& query) const;
    // The same over pairs of postings, each weighed by the code and by table[Hamming distance of the signatures]; pairs
    // farther than `limit` count nothing. With `geometric`, orientation and scale must agree too: only the fullest bin of each of the
    // two differences counts, and of both the lesser (Jegou, Douze and Schmid, ECCV 2008).
    Scores near_votes(const QueryView& query, const float* table, int limit, bool geometric) const;

    Snapshot snapshot() const;
    void attach(Snapshot snapshot);

    int64_t n_slots() const;
    int64_t n_live() const;
    size_t bytes() const;  // of all lists, mapped ones too
    int64_t n_words() const { return n_words_; }
    int64_t block_places() const { return block_places_; }
    bool with_signatures() const { return with_signatures_; }
    bool with_geometry() const { return with_geometry_; }

private:
    template <class Lists>
    void look_up(const Lists& lists, const QueryView& query, std::vector<ListView>& found) const;
    template <class Each>
    void visit_blocks(const QueryView& query, Each each) const;
    Block gather(int64_t first, int64_t n, const std::vector<int32_t>& rank, const std::vector<Block>& from) const;
    Block freeze_head() const;
    Scores room(int64_t per_slot) const;  // zeros
    Scores finished(Scores scores, float mass) const;

    const int64_t n_words_, block_places_;
    const bool with_signatures_, with_geometry_;
    const std::array<float, kCodes> code_weights_, code_shares_;
    const Kernels& kernels_;

    std::mutex writer_;
    mutable std::shared_mutex state_;
    std::vector<Block> sealed_;
    Head head_;
    std::vector<float> masses_;  // infinite where a place was removed
    std::vector<uint8_t> live_;
    int64_t n_live_ = 0;
};

// The k slots of the highest scores, best first, the lower slot of equal ones.
std::vector<int32_t> top(const float* scores, int64_t n, int64_t k);

}  // namespace seamark
