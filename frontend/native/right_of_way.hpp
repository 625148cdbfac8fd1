// The right of way of a thread that must answer over one that has time.
#pragma once

#include <atomic>
#include <chrono>
#include <thread>

namespace seamark {

// One thread takes the way and gives it back; another lets it pass wherever it can stand still. It looks again from time
// to time and is not woken: that would take the core from the first thread just when it has its answer. Nobody waits
// long for a thread that the system has starved: when patience has run out, the way counts for nothing until it is taken
// anew.
class RightOfWay {
public:
    void take() { taken_.store(true, std::memory_order_relaxed); }
    void give_back() { taken_.store(false, std::memory_order_relaxed); }
    bool taken() const { return taken_.load(std::memory_order_relaxed); }

    void let_pass() {
        for (int look = 0; taken(); ++look) {
            if (look == kLooks) return give_back();
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
    }

private:
    static constexpr int kLooks = 50;
    std::atomic<bool> taken_{false};
};

}  // namespace seamark
