// How every exported function of the library ends: with a number, whatever was thrown, since an exception that crossed the
// C interface would end the process. smplxpp/native/__init__.py says them again, and turns them into Python's exceptions.
// WebAssembly is built without exceptions: there the module traps, which the page's JavaScript catches.
#pragma once
#include <cstdint>
#include <new>
#include <stdexcept>

#define SMPLXPP_EXPORT extern "C" __attribute__((visibility("default")))

namespace smplxpp {

constexpr int32_t DONE = 0, OUT_OF_MEMORY = 1, OUT_OF_RANGE = 2, OVER_LIMIT = 3, FAILED = 4;

// More work than the caller allows.
struct OverLimit {};

#if defined(__cpp_exceptions)
[[noreturn]] inline void throw_out_of_range(const char* what) { throw std::out_of_range(what); }
[[noreturn]] inline void throw_over_limit() { throw OverLimit(); }

template <class Work>
int32_t guarded(Work&& work) noexcept {
    try {
        work();
        return DONE;
    } catch (const std::bad_alloc&) {
        return OUT_OF_MEMORY;
    } catch (const std::length_error&) {  // a vector longer than any memory
        return OUT_OF_MEMORY;
    } catch (const std::out_of_range&) {
        return OUT_OF_RANGE;
    } catch (const OverLimit&) {
        return OVER_LIMIT;
    } catch (...) {
        return FAILED;
    }
}
#else
[[noreturn]] inline void throw_out_of_range(const char*) { __builtin_trap(); }
[[noreturn]] inline void throw_over_limit() { __builtin_trap(); }

template <class Work>
int32_t guarded(Work&& work) noexcept {
    work();
    return DONE;
}
#endif

// Every index in [0, bound), or it is refused.
template <class Index>
void check_indices(const Index* indices, int64_t count, int64_t bound) {
    bool outside = false;
    for (int64_t i = 0; i < count; ++i) outside |= (uint64_t)(int64_t)indices[i] >= (uint64_t)bound;
    if (outside) throw_out_of_range("index");
}

}  // namespace smplxpp
