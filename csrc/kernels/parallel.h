// One parallel loop over tasks. Tasks write disjoint memory, so results do not depend on the thread count.
//
// OpenMP, because its thread team is warm from one call to the next and, within torch, shared with torch. Two cases
// take std::thread instead: builds without OpenMP (also ThreadSanitizer, which cannot see libgomp's barriers), and
// forked children, where libgomp waits forever for a team that the fork did not copy.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <system_error>
#include <thread>
#include <vector>

#ifdef _OPENMP
#include <omp.h>
#endif
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

namespace fisheyerec {

inline int default_thread_count() {
#ifdef _OPENMP
  return omp_get_max_threads();
#else
  return static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
#endif
}

// Whether this process came out of a fork made after the library was loaded.
inline std::atomic<bool> forked_child{false};
#if defined(__unix__) || defined(__APPLE__)
inline const int fork_handler = pthread_atfork(nullptr, nullptr, [] { forked_child = true; });
#endif

// Calls body(task) for task = 0 .. task_count - 1, in any order, on up to `threads` threads. body must not throw.
template <class Body>
void parallel_for(int64_t task_count, int threads, const Body& body) {
  threads = static_cast<int>(std::min<int64_t>(threads, task_count));
  if (threads <= 1) {
    for (int64_t task = 0; task < task_count; ++task) body(task);
    return;
  }
#ifdef _OPENMP
  if (!forked_child) {
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int64_t task = 0; task < task_count; ++task) body(task);
    return;
  }
#endif
  std::atomic<int64_t> next{0};
  const auto work = [&] {
    for (int64_t task; (task = next++) < task_count;) body(task);
  };
  std::vector<std::thread> helpers;
  try {
    for (int i = 1; i < threads; ++i) helpers.emplace_back(work);
  } catch (const std::system_error&) {  // no more threads to be had: those that started do the work
  }
  work();
  for (std::thread& helper : helpers) helper.join();
}

}  // namespace fisheyerec
