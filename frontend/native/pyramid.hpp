// An image and its halves, each with room around it, so that a patch at the border can be read without a question.
#pragma once

#include <cstdint>
#include <vector>

namespace seamark {

struct Level {
    const uint8_t* pixels;  // of (0, 0); kRoom columns and rows around the image can be read and mean nothing
    int64_t stride;
    int width, height;
};

class Pyramid {
public:
    static constexpr int kRoom = 32;
    static constexpr int kLeast = 16;  // pixels that the shorter side of a reduced level has at least

    // Copies a grey image and reduces it at most `n_levels` times: binomial filter of 5 x 5, every other pixel of every
    // other row (Burt and Adelson 1983), the border mirrored.
    Pyramid(const uint8_t* grey, int width, int height, int n_levels);

    int top() const { return static_cast<int>(levels_.size()) - 1; }
    const Level& operator[](int level) const { return levels_[level]; }

private:
    uint8_t* add(int width, int height);

    std::vector<Level> levels_;
    std::vector<std::vector<uint8_t>> memory_;
};

}  // namespace seamark
