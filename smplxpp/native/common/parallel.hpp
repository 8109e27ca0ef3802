// Running a function on several threads, and what every exported function of the library is marked with.
#pragma once
#include <cstddef>
#ifdef _OPENMP
#include <omp.h>
#else
#include <thread>
#include <vector>
#endif

#define SMPLXPP_EXPORT extern "C" __attribute__((visibility("default")))

namespace smplxpp {

// Calls work(thread) for thread = 0 .. threads-1, each exactly once, and returns when all are done. With OpenMP the threads
// are those that torch uses too (one libgomp a process), so neither waits for the other's to fall asleep. Work must be
// dealt by the index alone: a runtime that grants fewer threads than asked runs several indices on one of them.
template <class Work>
void run_threads(int threads, Work&& work) {
    if (threads <= 1) {
        work(0);
        return;
    }
#ifdef _OPENMP
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int t = 0; t < threads; ++t) work(t);
#else
    std::vector<std::thread> pool;
    for (int t = 1; t < threads; ++t) pool.emplace_back([&work, t] { work(t); });
    work(0);
    for (auto& t : pool) t.join();
#endif
}

}  // namespace smplxpp
