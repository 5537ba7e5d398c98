// A small thread pool: no barriers with static shares, so a core taken by somebody else delays a call by one chunk at most.
#pragma once

namespace p2gs {

// Calls fn(chunk, thread, ctx) once for every chunk in [0, chunks). The caller takes part as thread 0; up to threads - 1
// helpers join as threads 1 .. threads-1 when they are free. Chunks are handed out in ascending order, to whoever asks first:
// results must not depend on which thread took which chunk. fn must not throw.
// Any thread may call; while one call runs, others (and calls from inside fn) run serially on their own thread.
// Safe after fork: the child starts with helpers of its own.
void parallel_for(int chunks, int threads, void (*fn)(int chunk, int thread, void* ctx), void* ctx);

// Helper threads alive now (for tests).
int pool_size();

}  // namespace p2gs
