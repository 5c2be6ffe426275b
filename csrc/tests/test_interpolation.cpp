#include "../geometry/interpolation.h"

#include <algorithm>
#include <random>

#include "check.h"

using namespace fisheyerec;

namespace {

// Beyond 2^24 not every pixel's coordinate is a float of its own, and size - 1 may round up to size.
constexpr int sizes[] = {1, 2, 3, 7, 640, 1 << 24, (1 << 24) + 4, 1 << 30};

template <class T>
std::vector<T> awkward_coordinates(int size) {
  constexpr T infinity = std::numeric_limits<T>::infinity();
  const T n = static_cast<T>(size);
  std::vector<T> around;
  for (const T x : {T(-1), T(-0.5), T(0), T(0.5), T(1), n - T(1.5), n - 1, n - T(0.5), n, n + 1, n / 2}) {
    around.push_back(x);
    around.push_back(std::nextafter(x, infinity));
    around.push_back(std::nextafter(x, -infinity));
  }
  for (const T x : {T(1e-30), T(-1e-30), T(-0.0), T(2147483520), T(2147483648), T(-2147483648), T(4294967296), T(1e19),
                    T(1e30), std::numeric_limits<T>::max(), std::numeric_limits<T>::lowest(),
                    std::numeric_limits<T>::denorm_min(), infinity, -infinity, std::numeric_limits<T>::quiet_NaN()}) {
    around.push_back(x);
  }
  return around;
}

// The pixels that a tap multiplies its weights (or slopes) with, as the kernels read them.
template <class T>
double apply(const T (&factors)[2], const Tap<T>& tap, int size, const double* v) {
  return factors[0] * v[tap.index] + factors[1] * v[size > 1 ? tap.index + 1 : tap.index];
}

// The pixel of a nearest tap: its weight lies on one neighbour, and where that is the first there may be no second.
template <class T>
int nearest_pixel(const Tap<T>& tap) {
  return tap.index + (tap.weight[1] > 0 ? 1 : 0);
}

// What the taps must give, straight from the definition: every pixel carries a tent of width 1.
template <class T>
long double tents(T x, int size, const double* v) {
  long double sum = 0;
  for (int i = 0; i < size; ++i) sum += v[i] * std::max(0.0L, 1 - std::abs(static_cast<long double>(x) - i));
  return sum;
}

template <class T>
void check_taps() {
  constexpr T epsilon = std::numeric_limits<T>::epsilon();
  const double v[7] = {3, -5, 2, 8, -1, 4, 6};
  for (const int size : sizes) {
    for (const T x : awkward_coordinates<T>(size)) {
      const Tap<T> zeros = linear_tap_zeros(x, size), border = linear_tap_border(x, size);
      const Tap<T> nearest = nearest_tap(x, size, false), extended = nearest_tap(x, size, true);
      for (const Tap<T>& tap : {zeros, border, nearest, extended}) {
        CHECK(tap.weight[0] >= 0 && tap.weight[1] >= 0);
        CHECK(size > 1 || tap.weight[1] == 0);
      }
      for (const Tap<T>& tap : {zeros, border}) CHECK(tap.index >= 0 && tap.index <= std::max(size - 2, 0));
      for (const Tap<T>& tap : {nearest, extended}) CHECK(tap.index >= 0 && nearest_pixel(tap) < size);
      CHECK(zeros.live == (x > -1 && x < static_cast<T>(size)));
      CHECK(nearest.live == inside(x, static_cast<T>(size)));
      CHECK(border.live == !std::isnan(x) && extended.live == !std::isnan(x));
      if (std::isnan(x)) continue;

      const T clamped = std::min(std::max(x, T(0)), static_cast<T>(size - 1));
      // Where a coordinate has no fraction left, size - 1 itself may be rounded.
      const double rounding = epsilon * std::max(1.0, static_cast<double>(clamped));
      CHECK_NEAR(border.weight[0] + border.weight[1], 1, epsilon);
      CHECK_NEAR(border.index + static_cast<double>(border.weight[1]), clamped, rounding);
      CHECK(zeros.weight[0] + zeros.weight[1] <= 1 + epsilon);
      CHECK(extended.weight[0] + extended.weight[1] == 1 && extended.weight[0] * extended.weight[1] == 0);
      CHECK_NEAR(nearest_pixel(extended), clamped, 0.5 + rounding);
      for (int side = 0; side < 2; ++side) CHECK(nearest.weight[side] == (nearest.live ? extended.weight[side] : 0));
      if (size > 7) continue;

      CHECK_NEAR(zeros.live ? apply(zeros.weight, zeros, size, v) : 0, std::isfinite(x) ? tents(x, size, v) : 0,
                 40 * epsilon);
      CHECK_NEAR(apply(border.weight, border, size, v), tents(clamped, size, v), 40 * epsilon);
    }
  }
}

template <class T>
void check_reproduction() {
  constexpr T epsilon = std::numeric_limits<T>::epsilon();
  std::mt19937_64 random(10);
  constexpr int size = 640;
  std::uniform_real_distribution<T> uniform(0, size - 1);
  for (int repeat = 0; repeat < 20000; ++repeat) {
    const T x = repeat < size ? static_cast<T>(repeat) : uniform(random);
    for (const Tap<T>& tap : {linear_tap_zeros(x, size), linear_tap_border(x, size)}) {
      CHECK_NEAR(tap.weight[0] + tap.weight[1], 1, epsilon);
      CHECK_NEAR(tap.weight[0] * (2 * tap.index + 1) + tap.weight[1] * (2 * tap.index + 3), 2 * x + 1,
                 4 * epsilon * size);
    }
  }
}

// The slope is the derivative within each cell, and that of the cell to the right at integers.
template <class T>
void check_slopes() {
  const double v[3] = {3, -5, 2};
  const T h = T(1) / 1024;
  for (const int size : {1, 2, 3}) {
    for (int i = -3 * 16; i <= 5 * 16; ++i) {
      const T x = static_cast<T>(i) / 16, last = static_cast<T>(size - 1);
      const T clamped = std::min(std::max(x, T(0)), last), ahead = std::min(std::max(x + h, T(0)), last);
      const Tap<T> zeros = linear_tap_zeros(x, size), border = linear_tap_border(x, size);
      // At -1 itself nothing is read, although the value is about to rise.
      if (x != -1) {
        CHECK_NEAR(zeros.live ? apply(zeros.slope, zeros, size, v) : 0, (tents(x + h, size, v) - tents(x, size, v)) / h,
                   1e-9);
      }
      CHECK_NEAR(apply(border.slope, border, size, v), (tents(ahead, size, v) - tents(clamped, size, v)) / h, 1e-9);
      const Tap<T> nearest = nearest_tap(x, size, true);
      CHECK(nearest.slope[0] == 0 && nearest.slope[1] == 0);
    }
  }
}

// Every lane of a vector is told what a scalar would be.
template <int count>
void check_vectors() {
  using T = typename VectorOf<float, count>::type;
  for (const int size : sizes) {
    const std::vector<float> all = awkward_coordinates<float>(size);
    for (size_t first = 0; first + count <= all.size(); ++first) {
      const T x = load_lanes<T>(all.data() + first);
      const Tap<T> vectors[] = {linear_tap_zeros(x, size), linear_tap_border(x, size), nearest_tap(x, size, false),
                                nearest_tap(x, size, true)};
      for (int lane = 0; lane < count; ++lane) {
        const float one = all[first + static_cast<size_t>(lane)];
        const Tap<float> scalars[] = {linear_tap_zeros(one, size), linear_tap_border(one, size),
                                      nearest_tap(one, size, false), nearest_tap(one, size, true)};
        for (int kind = 0; kind < 4; ++kind) {
          CHECK(vectors[kind].index[lane] == scalars[kind].index);
          CHECK((vectors[kind].live[lane] != 0) == scalars[kind].live);
          for (int side = 0; side < 2; ++side) {
            CHECK(vectors[kind].weight[side][lane] == scalars[kind].weight[side]);
            CHECK(vectors[kind].slope[side][lane] == scalars[kind].slope[side]);
          }
        }
      }
    }
  }
}

}  // namespace

TEST(taps_stay_inside_the_image_and_read_what_the_definition_says) {
  check_taps<float>();
  check_taps<double>();
}

TEST(linear_taps_reproduce_linear_images) {
  check_reproduction<float>();
  check_reproduction<double>();
}

TEST(slopes_are_the_derivatives_of_the_values) {
  check_slopes<float>();
  check_slopes<double>();
}

TEST(vectors_of_taps_are_taps) {
  check_vectors<4>();
  check_vectors<8>();
  check_vectors<16>();
}
