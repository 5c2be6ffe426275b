// A check harness of one header: a test program includes it once, writes TEST(name) { CHECK(...); } and is done.
#pragma once

#include <cmath>
#include <cstdio>
#include <cstring>
#include <vector>

namespace check {

struct Test {
  const char* name;
  void (*body)();
};
inline std::vector<Test> tests;
inline int failures = 0;          // of the running test
inline const char* subject = "";  // what a test that walks a table is looking at

struct Registration {
  Registration(const char* name, void (*body)()) { tests.push_back({name, body}); }
};

// Whether one more failure is worth a line.
inline bool fail() { return ++failures <= 10; }

// Runs the tests whose names contain `part`.
inline int run(const char* part) {
  int passed = 0, failed = 0;
  for (const Test& test : tests) {
    if (!std::strstr(test.name, part)) continue;
    std::printf("%s\n", test.name);
    std::fflush(stdout);  // a crash then says where
    failures = 0;
    subject = "";
    test.body();
    if (failures > 0) std::printf("FAILED %s: %d checks\n", test.name, failures);
    ++(failures > 0 ? failed : passed);
  }
  std::printf("%d passed, %d failed\n", passed, failed);
  return failed > 0;
}

}  // namespace check

#define TEST(name)                                                   \
  static void name();                                                \
  static const check::Registration name##_registration{#name, name}; \
  static void name()

#define CHECK(condition)                                                                     \
  do {                                                                                       \
    if (!(condition) && check::fail())                                                       \
      std::printf("%s:%d: %s: CHECK(%s)\n", __FILE__, __LINE__, check::subject, #condition); \
  } while (false)

// NaN is near nothing.
#define CHECK_NEAR(actual, expected, tolerance)                                                                       \
  do {                                                                                                                \
    const double a_ = static_cast<double>(actual), e_ = static_cast<double>(expected);                                \
    const double t_ = static_cast<double>(tolerance);                                                                 \
    if (!(std::abs(a_ - e_) <= t_) && check::fail())                                                                  \
      std::printf("%s:%d: %s: %s = %.17g, expected %s = %.17g, off by %g > %g\n", __FILE__, __LINE__, check::subject, \
                  #actual, a_, #expected, e_, std::abs(a_ - e_), t_);                                                 \
  } while (false)

int main(int argc, char** argv) { return check::run(argc > 1 ? argv[1] : ""); }
