// Memory that grows and is not cleared: page faults and zeroing cost more than the arithmetic of a large image.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <utility>
#if defined(__linux__)
#include <sys/mman.h>
#elif defined(_WIN32)
#include <malloc.h>
#endif

namespace smplxpp {

// Windows has no aligned_alloc, and another function to free what its own gives.
inline void* aligned_block(size_t align, size_t bytes) {
#if defined(_WIN32)
    return _aligned_malloc(bytes, align);
#else
    return std::aligned_alloc(align, bytes);
#endif
}
inline void free_block(void* block) {
#if defined(_WIN32)
    _aligned_free(block);
#else
    std::free(block);
#endif
}

// An array of trivial elements, aligned to a cache line, or to a huge page where it fills half of one.
template <class T>
class Buffer {
public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    Buffer(Buffer&& other) noexcept : data_(std::exchange(other.data_, nullptr)), capacity_(std::exchange(other.capacity_, 0)) {}
    ~Buffer() { free_block((void*)data_); }

    // Room for n elements; what was there before is lost when the room has to grow.
    T* reserve(int64_t n) {
        if (n > capacity_) {
            free_block((void*)data_);
            data_ = nullptr;
            capacity_ = 0;
            allocate(n + n / 4);
        }
        return data_;
    }
    // Room for n elements, the first `kept` of which stay.
    T* grow(int64_t n, int64_t kept) {
        if (n > capacity_) {
            T* old = data_;
            data_ = nullptr;
            capacity_ = 0;
            try {
                allocate(n + n / 2);
            } catch (...) {
                free_block((void*)old);
                throw;
            }
            if (kept) __builtin_memcpy((void*)data_, (const void*)old, sizeof(T) * (size_t)kept);
            free_block((void*)old);
        }
        return data_;
    }
    T* data() const { return data_; }
    T& operator[](int64_t i) const { return data_[i]; }
    int64_t capacity() const { return capacity_; }
    size_t bytes() const { return sizeof(T) * (size_t)capacity_; }

private:
    void allocate(int64_t n) {
        constexpr size_t line = 64, huge = size_t(1) << 21;
        const size_t bytes = sizeof(T) * (size_t)n, align = bytes >= huge / 2 ? huge : line;
        data_ = (T*)aligned_block(align, (bytes + align - 1) / align * align);
        if (!data_) throw std::bad_alloc();
        capacity_ = n;
#if defined(__linux__)
        if (align == huge) madvise((void*)data_, (bytes + align - 1) / align * align, MADV_HUGEPAGE);
#endif
    }
    T* data_ = nullptr;
    int64_t capacity_ = 0;
};

}  // namespace smplxpp
