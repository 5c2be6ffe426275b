#include "../kernels/parallel.h"

#include <memory>

#if defined(__unix__) || defined(__APPLE__)
#include <sys/wait.h>
#include <unistd.h>
#endif

#include "check.h"

using namespace fisheyerec;

namespace {

bool every_task_ran_once(int64_t task_count, int threads) {
  const auto size = static_cast<size_t>(task_count);
  const std::unique_ptr<std::atomic<int>[]> runs(new std::atomic<int>[size + 1]());
  parallel_for(task_count, threads, [&](int64_t task) { ++runs[static_cast<size_t>(task)]; });
  for (size_t task = 0; task < size; ++task) {
    if (runs[task] != 1) return false;
  }
  return runs[size] == 0;
}

bool all_shapes_run() {
  for (const int64_t task_count : {0, 1, 2, 7, 64, 5000}) {
    for (const int threads : {-1, 0, 1, 2, 3, 7, 50}) {
      if (!every_task_ran_once(task_count, threads)) return false;
    }
  }
  return true;
}

}  // namespace

TEST(every_task_runs_exactly_once) { CHECK(all_shapes_run()); }

TEST(tasks_run_side_by_side) {
  std::atomic<int> arrived{0}, met{0};
  parallel_for(2, 2, [&](int64_t) {
    ++arrived;
    for (int wait = 0; wait < 10000 && arrived < 2; ++wait) std::this_thread::sleep_for(std::chrono::milliseconds(1));
    met += arrived == 2;
  });
  CHECK(met == 2);
}

TEST(there_is_at_least_one_thread) { CHECK(default_thread_count() >= 1); }

#if defined(__unix__) || defined(__APPLE__)
// A DataLoader worker calls the op after its parent did; libgomp's team does not survive the fork.
TEST(a_forked_child_runs_its_tasks) {
  CHECK(all_shapes_run());
  const pid_t child = fork();
  if (child == 0) {
    alarm(30);  // a deadlock ends the child by a signal
    const bool child_ran = forked_child && all_shapes_run();
    const pid_t grandchild = fork();
    if (grandchild == 0) {
      alarm(30);
      _exit(all_shapes_run() ? 0 : 1);
    }
    int status = 1;
    waitpid(grandchild, &status, 0);
    _exit(child_ran && status == 0 ? 0 : 1);
  }
  CHECK(child > 0);
  int status = 1;
  CHECK(waitpid(child, &status, 0) == child);
  CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 0);
  CHECK(!forked_child);
  CHECK(all_shapes_run());
}
#endif
