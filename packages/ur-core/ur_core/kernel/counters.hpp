// Counters in memory that processes share, such as the number of rows that a reader may read.
//
// What was written before a store is seen by whoever loads its value. Processors other than x86 reorder plain stores
// and loads. The fences also order what follows a store and what precedes a load: a reader that loads the counter again
// learns whether the rows that it has read meanwhile were overwritten.
#pragma once

#include <stdint.h>

#include "fields.hpp"

EXPORT void counter_store(int64_t* counter, int64_t value) {
    __atomic_store_n(counter, value, __ATOMIC_RELEASE);
    __atomic_thread_fence(__ATOMIC_RELEASE);
}

EXPORT int64_t counter_load(const int64_t* counter) {
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    return __atomic_load_n(counter, __ATOMIC_ACQUIRE);
}

// Store a value where another one is found; return 1 if it was, and 0 if the counter is unchanged.
EXPORT int64_t counter_swap(int64_t* counter, int64_t found, int64_t value) {
    return __atomic_compare_exchange_n(counter, &found, value, false, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE);
}
