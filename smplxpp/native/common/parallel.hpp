// Running a function on several threads; in WebAssembly on the workers that a page has (web/threads.cpp), where work may
// not allocate: its malloc is of one thread.
#pragma once
#if defined(__wasm__)
#include <type_traits>

namespace smplxpp {

void deal_slices(int slices, void (*run)(void* work, int slice), void* work);

template <class Work>
void run_threads(int threads, Work&& work) {
    deal_slices(threads, [](void* own, int slice) { (*(std::remove_reference_t<Work>*)own)(slice); }, &work);
}

}  // namespace smplxpp

#else
#include <atomic>
#include <cstddef>
#include <mutex>
#include <thread>
#include <vector>
#ifdef _OPENMP
#include <omp.h>
#endif

#include "common/failure.hpp"
#include "common/status.hpp"

namespace smplxpp {

// As many of the `asked` threads as the system starts, the caller's among them. OpenMP's runtime ends the process where it
// gets fewer than it asked for, so more than were ever seen are tried out first.
inline int granted_threads(int asked) {
    static std::atomic<int> seen{1};
    static std::mutex mutex;
    if (asked <= seen) return asked;
    const std::lock_guard<std::mutex> lock(mutex);
    std::mutex gate;
    std::vector<std::thread> probe;
    {
        const std::lock_guard<std::mutex> closed(gate);  // all of them at once
        try {
            probe.reserve((size_t)asked);
            while ((int)probe.size() + 1 < asked) probe.emplace_back([&gate] { const std::lock_guard<std::mutex> pass(gate); });
        } catch (const std::exception&) {
            // The system's limit: those that have started count.
        }
    }
    for (std::thread& thread : probe) thread.join();
    const int granted = (int)probe.size() + 1;
    if (granted > seen) seen = granted;
    return granted;
}

// Calls work(thread) for thread = 0 .. threads-1, each exactly once, and returns when all are done; the first exception of
// any is thrown here. With OpenMP the threads are those that torch uses too (one libgomp a process), so neither waits for
// the other's to fall asleep. Work must be dealt by the index alone: where fewer threads are granted than asked, several
// indices run on one of them.
template <class Work>
void run_threads(int threads, Work&& work) {
    if (threads <= 1) {
        work(0);
        return;
    }
    Failure failure;
    const int granted = granted_threads(threads);
#ifdef _OPENMP
#pragma omp parallel for num_threads(granted) schedule(static, 1)
    for (int t = 0; t < threads; ++t) failure.guard([&] { work(t); });
#else
    const auto some = [&](int first) {
        for (int t = first; t < threads; t += granted) failure.guard([&] { work(t); });
    };
    std::vector<std::thread> pool;
    int started = 1;
    failure.guard([&] {
        pool.reserve((size_t)granted);
        for (; started < granted; ++started) pool.emplace_back(some, started);
    });
    for (int t = 0; t < granted; t = t == 0 ? started : t + 1) some(t);
    for (std::thread& thread : pool) thread.join();
#endif
    failure.rethrow();
}

}  // namespace smplxpp

#endif
