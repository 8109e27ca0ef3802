// Carries an exception out of a thread: one that left a parallel region by itself would end the process.
#pragma once
#include <exception>
#include <mutex>

namespace smplxpp {

class Failure {
public:
    template <class Work>
    void guard(Work&& work) {
        try {
            work();
        } catch (...) {
            std::lock_guard<std::mutex> lock(mutex_);
            if (!first_) first_ = std::current_exception();
        }
    }
    void rethrow() const {
        if (first_) std::rethrow_exception(first_);
    }

private:
    std::mutex mutex_;
    std::exception_ptr first_;
};

}  // namespace smplxpp
