// Plain loops for any processor.
#include "flow_loops.hpp"

namespace seamark {
namespace {

struct PlainRow {
    int16_t lanes[kLanes];

    struct Sum {
        int64_t sum = 0;
        void add(const PlainRow& a, const PlainRow& b) {
            int32_t row = 0;
            for (int i = 0; i < kLanes; ++i) row += a.lanes[i] * b.lanes[i];
            sum += row;
        }
        int64_t total() const { return sum; }
    };

    template <class Of>
    static PlainRow each(Of of) {
        PlainRow row;
        for (int i = 0; i < kLanes; ++i) row.lanes[i] = static_cast<int16_t>(of(i));
        return row;
    }
    static PlainRow all(int value) {
        return each([=](int) { return value; });
    }
    static PlainRow of_pixels(const uint8_t* pixels) {
        return each([=](int i) { return (pixels[i] - 128) * kGreyUnit; });
    }
    static PlainRow load(const int16_t* from) {
        return each([=](int i) { return from[i]; });
    }
    void store(int16_t* to) const {
        for (int i = 0; i < kLanes; ++i) to[i] = lanes[i];
    }
    PlainRow operator+(const PlainRow& b) const {
        return each([&](int i) { return lanes[i] + b.lanes[i]; });
    }
    PlainRow operator-(const PlainRow& b) const {
        return each([&](int i) { return lanes[i] - b.lanes[i]; });
    }
    PlainRow operator&(const PlainRow& b) const {
        return each([&](int i) { return lanes[i] & b.lanes[i]; });
    }
    // The product with a fraction in parts of kPixelUnit, rounded.
    PlainRow times(const PlainRow& fraction) const {
        return each([&](int i) { return (lanes[i] * fraction.lanes[i] + kPixelUnit / 2) >> 15; });
    }
};

}  // namespace

const FlowKernels kFlowBaseline = flow_kernels_of<PlainRow>("baseline");

}  // namespace seamark
