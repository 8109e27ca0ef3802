// Threads of the page: workers of one memory take slices of what the caller deals, as run_threads of common/parallel.hpp
// asks for. Whoever comes late, or never, leaves slices to the caller: it waits for nothing but slices that were taken.
// Built for WebAssembly alone (web/kernels.mjs).
#include <cstdint>

#include "common/parallel.hpp"
#include "common/status.hpp"

namespace {

constexpr uint64_t SLICES = 0xFFFF;       // of a ticket
constexpr int64_t PATIENCE = 5000000000;  // nanoseconds that a slice may take
constexpr int TIMED_OUT = 2;

// A ticket is turn << 16 | slices that nobody has taken. What a turn runs is written while no slice is left, so that
// whoever takes a slice of a ticket has read what belongs to it.
struct Desk {
    uint64_t ticket;
    int32_t left;     // slices that are not done
    int32_t helpers;  // workers beside the caller
    uint32_t helped;  // slices that they have done
    void (*run)(void*, int);
    void* work;
};
Desk desk;

uint32_t take_slices() {
    uint32_t taken = 0;
    uint64_t ticket = __atomic_load_n(&desk.ticket, __ATOMIC_SEQ_CST);
    while (ticket & SLICES) {
        const auto run = __atomic_load_n(&desk.run, __ATOMIC_SEQ_CST);
        void* const work = __atomic_load_n(&desk.work, __ATOMIC_SEQ_CST);
        if (!__atomic_compare_exchange_n(&desk.ticket, &ticket, ticket - 1, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) continue;
        run(work, (int)(ticket & SLICES) - 1);
        ++taken;
        if (__atomic_sub_fetch(&desk.left, 1, __ATOMIC_SEQ_CST) == 0) __builtin_wasm_memory_atomic_notify(&desk.left, 1);
        ticket = __atomic_load_n(&desk.ticket, __ATOMIC_SEQ_CST);
    }
    return taken;
}

}  // namespace

void smplxpp::deal_slices(int slices, void (*run)(void*, int), void* work) {
    if (!desk.helpers || slices < 2) {
        for (int t = 0; t < slices; ++t) run(work, t);
        return;
    }
    __atomic_store_n(&desk.run, run, __ATOMIC_SEQ_CST);
    __atomic_store_n(&desk.work, work, __ATOMIC_SEQ_CST);
    __atomic_store_n(&desk.left, slices, __ATOMIC_SEQ_CST);
    const uint64_t turn = (desk.ticket >> 16) + 1;
    __atomic_store_n(&desk.ticket, turn << 16 | (uint64_t)slices, __ATOMIC_SEQ_CST);
    __builtin_wasm_memory_atomic_notify((int*)&desk.ticket, (unsigned)desk.helpers);
    take_slices();
    while (const int32_t left = __atomic_load_n(&desk.left, __ATOMIC_SEQ_CST)) {
        if (__builtin_wasm_memory_atomic_wait32(&desk.left, left, PATIENCE) == TIMED_OUT) __builtin_trap();
    }
}

// How many workers will help from now on.
SMPLXPP_EXPORT void smplxpp_web_helpers(int32_t count) { desk.helpers = count; }

// Slices that workers have done so far.
SMPLXPP_EXPORT uint32_t smplxpp_web_helped() { return __atomic_load_n(&desk.helped, __ATOMIC_SEQ_CST); }

// What a worker does for the rest of its life.
SMPLXPP_EXPORT void smplxpp_web_help() {
    for (;;) {
        __atomic_fetch_add(&desk.helped, take_slices(), __ATOMIC_SEQ_CST);
        const uint64_t ticket = __atomic_load_n(&desk.ticket, __ATOMIC_SEQ_CST);
        if (!(ticket & SLICES)) __builtin_wasm_memory_atomic_wait64((long long*)&desk.ticket, (int64_t)ticket, -1);
    }
}
