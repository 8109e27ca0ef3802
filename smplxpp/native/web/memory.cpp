// Memory of the page's module: what does not fit ends in a trap, which says itself to JavaScript; libc++'s own way out
// would print it, and bring the half of a C library along.
#include <cstdlib>
#include <new>

#include "common/status.hpp"

void* operator new(size_t bytes) {
    void* place = std::malloc(bytes ? bytes : 1);
    if (!place) __builtin_trap();
    return place;
}
void operator delete(void* place) noexcept { std::free(place); }
void operator delete(void* place, size_t) noexcept { std::free(place); }

// Sixteen bytes at least are its alignment, so that vectors may begin there. Null: no memory is left.
SMPLXPP_EXPORT void* smplxpp_web_allocate(size_t bytes) { return std::malloc(bytes); }
