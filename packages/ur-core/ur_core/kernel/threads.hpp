// Threads that share the rows of a call; see `ur_core.kernel.RowLoop`.
//
// They begin with the first call that needs them and wait for the next one: first awake, since the next call of a
// control period comes soon, then asleep. A forked process begins its own, for what is
// made in it: environments of the parent that have MuJoCo's threads are refused there. They end with the process.
#pragma once

#include <pthread.h>
#include <signal.h>
#include <stdint.h>

#include "fields.hpp"

// Function of a structure that computes the rows from the first to the one before the last.
typedef void (*Rows)(const void* of, int64_t first, int64_t last);

namespace threads {

constexpr int64_t PORTION = 4;   // rows that a thread takes at a time: their cost differs
constexpr int64_t MOST = 256;
constexpr int AWAKE = 1000;      // rounds of waiting before a thread sleeps: some tens of microseconds

struct Pool {
    pthread_mutex_t busy = PTHREAD_MUTEX_INITIALIZER;   // held by a caller
    pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;  // guards all that follows
    pthread_cond_t begun = PTHREAD_COND_INITIALIZER, done = PTHREAD_COND_INITIALIZER;
    int64_t started = 0, wanted = 0, working = 0;       // threads: all, yet to join the running call, in it
    // The running call, and its first row that nobody has taken.
    Rows rows = nullptr;
    const void* of = nullptr;
    int64_t n = 0, next = 0;
};

Pool pool;

// After a fork: the child has one thread, whatever the others held.
void forget() { pool = Pool(); }

inline int64_t now(const int64_t& value) { return __atomic_load_n(&value, __ATOMIC_ACQUIRE); }

inline void pause_briefly() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
}

void work() {
    for (;;) {
        const int64_t first = __atomic_fetch_add(&pool.next, PORTION, __ATOMIC_RELAXED);
        if (first >= pool.n) return;
        pool.rows(pool.of, first, first + PORTION < pool.n ? first + PORTION : pool.n);
    }
}

void* serve(void*) {
    pthread_mutex_lock(&pool.mutex);
    for (;;) {
        if (!pool.wanted) {
            pthread_mutex_unlock(&pool.mutex);
            for (int k = 0; k < AWAKE && !now(pool.wanted); ++k) pause_briefly();
            pthread_mutex_lock(&pool.mutex);
            while (!pool.wanted) pthread_cond_wait(&pool.begun, &pool.mutex);
        }
        __atomic_store_n(&pool.wanted, pool.wanted - 1, __ATOMIC_RELEASE);
        ++pool.working;
        pthread_mutex_unlock(&pool.mutex);
        work();
        pthread_mutex_lock(&pool.mutex);
        __atomic_store_n(&pool.working, pool.working - 1, __ATOMIC_RELEASE);
        if (!pool.working) pthread_cond_signal(&pool.done);
    }
    return nullptr;
}

// Start threads until there are so many; fewer where the system refuses one. They take no signals.
void start(int64_t count) {
    if (!pool.started) pthread_atfork(nullptr, nullptr, forget);
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    pthread_t thread;
    while (pool.started < count && pthread_create(&thread, nullptr, serve, nullptr) == 0) {
        pthread_detach(thread);
        ++pool.started;
    }
    pthread_sigmask(SIG_SETMASK, &before, nullptr);
}

void share(Rows rows, const void* of, int64_t n, int64_t count) {
    pthread_mutex_lock(&pool.mutex);
    if (pool.started < count - 1) start(count - 1);
    pool.rows = rows, pool.of = of, pool.n = n, pool.next = 0;
    __atomic_store_n(&pool.wanted, count - 1, __ATOMIC_RELEASE);
    pthread_cond_broadcast(&pool.begun);
    pthread_mutex_unlock(&pool.mutex);
    work();
    // A thread that has not begun yet is not waited for: there is nothing left to do.
    pthread_mutex_lock(&pool.mutex);
    __atomic_store_n(&pool.wanted, 0, __ATOMIC_RELEASE);
    if (pool.working) {
        pthread_mutex_unlock(&pool.mutex);
        for (int k = 0; k < AWAKE && now(pool.working); ++k) pause_briefly();
        pthread_mutex_lock(&pool.mutex);
        while (pool.working) pthread_cond_wait(&pool.done, &pool.mutex);
    }
    pthread_mutex_unlock(&pool.mutex);
}

}  // namespace threads

// Compute rows 0 to `n` on at most `count` threads; while another caller has them, on this one alone.
EXPORT void share_rows(Rows rows, const void* of, int64_t n, int64_t count) {
    if (count < 2 || pthread_mutex_trylock(&threads::pool.busy)) return rows(of, 0, n);
    threads::share(rows, of, n, count < threads::MOST ? count : threads::MOST);
    pthread_mutex_unlock(&threads::pool.busy);
}
