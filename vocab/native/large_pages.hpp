// Memory for arrays that are read at random: in large pages, where the system gives them, so that finding an address
// does not cost more than reading it.
#pragma once

#include <cstdlib>
#include <new>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace seamark {

template <class T>
struct LargePages {
    using value_type = T;
    static constexpr size_t kPage = size_t{2} << 20;

    LargePages() = default;
    template <class U>
    LargePages(const LargePages<U>&) {}

    T* allocate(size_t n) {
        const size_t size = n * sizeof(T);
        void* memory = nullptr;
        if (size < kPage) {
            memory = std::malloc(size);
        } else {
            memory = std::aligned_alloc(kPage, (size + kPage - 1) / kPage * kPage);
#if defined(__linux__)
            if (memory) madvise(memory, size, MADV_HUGEPAGE);
#endif
        }
        if (!memory) throw std::bad_alloc();
        return static_cast<T*>(memory);
    }
    void deallocate(T* memory, size_t) { std::free(memory); }
    bool operator==(const LargePages&) const { return true; }
    bool operator!=(const LargePages&) const { return false; }
};

template <class T>
using LargeVector = std::vector<T, LargePages<T>>;

}  // namespace seamark
