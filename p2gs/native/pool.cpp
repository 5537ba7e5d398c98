#include "pool.h"

#include <pthread.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>

namespace p2gs {
namespace {

constexpr auto kSpin = std::chrono::microseconds(20);
// A helper then looks on for so long before it sleeps, giving its core to whoever wants it: a training step calls again within that time,
// and waking a sleeper costs the caller some 30 us.
constexpr auto kLinger = std::chrono::microseconds(500);
constexpr int kMaxHelpers = 255;

inline void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

template <class Condition>
bool spin_until(Condition&& done) {
    auto end = std::chrono::steady_clock::now() + kSpin;
    do {
        for (int i = 0; i < 32; ++i) {
            if (done()) return true;
            pause();
        }
    } while (std::chrono::steady_clock::now() < end);
    return done();
}

template <class Condition>
bool linger_until(Condition&& done) {
    if (spin_until(done)) return true;
    auto end = std::chrono::steady_clock::now() + kLinger;
    do {
        for (int i = 0; i < 4; ++i) {
            if (done()) return true;
            std::this_thread::yield();
        }
    } while (std::chrono::steady_clock::now() < end);
    return done();
}

// One job at a time. `state` = epoch << 16 | open << 15 | helpers inside. A helper enters only an open job of an epoch it has not
// seen; the caller closes the job when no chunk is left and waits for those inside, never for those that have not woken yet.
class Pool {
public:
    bool try_acquire() { return !busy_.test_and_set(std::memory_order_acquire); }
    void release() { busy_.clear(std::memory_order_release); }

    void run(int chunks, int threads, void (*fn)(int, int, void*), void* ctx) {
        grow(threads - 1);
        fn_ = fn, ctx_ = ctx, chunks_ = chunks, limit_ = threads;
        next_.store(0, std::memory_order_relaxed);
        uint64_t epoch = (state_.load(std::memory_order_relaxed) >> 16) + 1;
        state_.store(epoch << 16 | kOpen);  // seq_cst, against `sleepers_` below
        if (sleepers_.load() > 0) {
            { std::lock_guard<std::mutex> lock(mutex_); }
            wake_.notify_all();
        }
        work(0);
        state_.fetch_and(~uint64_t(kOpen));
        auto empty = [this] { return (state_.load() & kInside) == 0; };
        if (!spin_until(empty)) {
            std::unique_lock<std::mutex> lock(mutex_);
            done_.wait(lock, empty);
        }
    }

    int size() const { return helpers_; }

private:
    static constexpr uint64_t kOpen = 1u << 15, kInside = kOpen - 1;

    void work(int thread) {
        for (;;) {
            int chunk = next_.fetch_add(1, std::memory_order_relaxed);
            if (chunk >= chunks_) return;
            fn_(chunk, thread, ctx_);
        }
    }

    bool enter(uint64_t& seen) {
        uint64_t s = state_.load();
        while ((s >> 16) != seen && (s & kOpen)) {
            if (state_.compare_exchange_weak(s, s + 1)) {
                seen = s >> 16;
                return true;
            }
        }
        seen = s >> 16;
        return false;
    }

    void helper(int thread) {
        uint64_t seen = 0;
        auto news = [&] { return (state_.load() >> 16) != seen; };
        for (;;) {
            if (!linger_until(news)) {
                std::unique_lock<std::mutex> lock(mutex_);
                sleepers_.fetch_add(1);
                wake_.wait(lock, news);
                sleepers_.fetch_sub(1);
            }
            if (!enter(seen)) continue;
            if (thread < limit_) work(thread);
            if (((state_.fetch_sub(1) - 1) & (kOpen | kInside)) == 0) {  // the last one out of a closed job
                { std::lock_guard<std::mutex> lock(mutex_); }
                done_.notify_one();
            }
        }
    }

    void grow(int wanted) {
        if (wanted > kMaxHelpers) wanted = kMaxHelpers;
        while (helpers_ < wanted) {
            try {
                std::thread(&Pool::helper, this, helpers_ + 1).detach();
            } catch (const std::system_error&) {
                return;  // no more threads to be had: fewer helpers, same result
            }
            ++helpers_;
        }
    }

    std::atomic<uint64_t> state_{0};
    std::atomic<int> next_{0};
    std::atomic<int> sleepers_{0};
    void (*fn_)(int, int, void*) = nullptr;
    void* ctx_ = nullptr;
    int chunks_ = 0, limit_ = 0;
    int helpers_ = 0;
    std::atomic_flag busy_ = ATOMIC_FLAG_INIT;
    std::mutex mutex_;
    std::condition_variable wake_, done_;
};

std::atomic<Pool*> g_pool{nullptr};

// The child of a fork has none of the helpers and perhaps a locked mutex: leave the old pool alone and start afresh.
void after_fork_in_child() { g_pool.store(nullptr); }

// Never destroyed: helpers sleep on its condition variable until the process ends.
Pool& pool() {
    static const int registered = pthread_atfork(nullptr, nullptr, after_fork_in_child);
    (void)registered;
    Pool* p = g_pool.load();
    if (!p) {
        Pool* fresh = new Pool;
        if (g_pool.compare_exchange_strong(p, fresh)) return *fresh;
        delete fresh;
    }
    return *p;
}

}  // namespace

void parallel_for(int chunks, int threads, void (*fn)(int, int, void*), void* ctx) {
    if (threads > 1 && chunks > 1) {
        Pool& p = pool();
        if (p.try_acquire()) {
            p.run(chunks, threads < chunks ? threads : chunks, fn, ctx);
            p.release();
            return;
        }
    }
    for (int chunk = 0; chunk < chunks; ++chunk) fn(chunk, 0, ctx);
}

int pool_size() {
    Pool* p = g_pool.load();
    return p ? p->size() : 0;
}

}  // namespace p2gs
