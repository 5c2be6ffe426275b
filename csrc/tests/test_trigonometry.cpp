#include "../geometry/trigonometry.h"

#include <algorithm>
#include <random>

#include "check.h"

using namespace fisheyerec;

namespace {

constexpr double epsilon = std::numeric_limits<float>::epsilon();

// |actual - exact| in units of the spacing of floats at `exact`.
double ulps(float actual, double exact) {
  const float nearest = static_cast<float>(std::abs(exact));
  const double spacing = std::nextafter(nearest, std::numeric_limits<float>::infinity()) - nearest;
  return std::abs(actual - exact) / spacing;
}

}  // namespace

TEST(float_atan2_stays_within_three_ulps) {
  std::mt19937_64 random(2);
  std::uniform_real_distribution<double> exponent(-30, 30), angle(0, pi<double>);
  double worst = 0;
  const auto look = [&](float y, float x) {
    worst = std::max(worst, ulps(atan2_upper(y, x), std::atan2(double(y), double(x))));
  };
  constexpr int count = 300000;
  for (int i = 0; i <= count; ++i) {
    const double theta = pi<double> * i / count;
    look(static_cast<float>(std::sin(theta)), static_cast<float>(std::cos(theta)));
    const double size = std::exp2(exponent(random)), other = angle(random);
    look(static_cast<float>(size * std::sin(other)), static_cast<float>(size * std::cos(other)));
    look(static_cast<float>(size), 1.0f);
    look(static_cast<float>(size), -1.0f);
  }
  CHECK_NEAR(worst, 0, 3);
}

TEST(float_sin_cos_stay_within_two_epsilon_and_near_their_zeros_too) {
  double worst_sin = 0, worst_cos = 0;
  constexpr int count = 2000000;
  for (int i = 0; i <= count; ++i) {
    const float theta = std::min(pi<float>, static_cast<float>(pi<double> * i / count));
    float s, c;
    sin_cos(theta, s, c);
    // Relative to the value: a ray near the axis or the image plane is as exact as any other.
    worst_sin = std::max(worst_sin, std::abs(s - std::sin(double(theta))) / std::max(std::sin(double(theta)), 1e-6));
    worst_cos =
        std::max(worst_cos, std::abs(c - std::cos(double(theta))) / std::max(std::abs(std::cos(double(theta))), 1e-6));
  }
  CHECK_NEAR(worst_sin, 0, 2 * epsilon);
  CHECK_NEAR(worst_cos, 0, 2 * epsilon);
}

template <class T>
void check_corners() {
  constexpr T tiny = std::numeric_limits<T>::min(), nan = std::numeric_limits<T>::quiet_NaN();
  constexpr T tolerance = 2 * std::numeric_limits<T>::epsilon();
  CHECK(atan2_upper(T(0), T(1)) == 0);
  CHECK(atan2_upper(T(0), tiny) == 0);
  CHECK(atan2_upper(T(0), T(0)) == 0);
  CHECK_NEAR(atan2_upper(T(0), T(-1)), pi<T>, tolerance);
  CHECK_NEAR(atan2_upper(T(1), T(0)), pi<T> / 2, tolerance);
  CHECK_NEAR(atan2_upper(tiny, T(0)), pi<T> / 2, tolerance);
  CHECK_NEAR(atan2_upper(T(1), T(1)), pi<T> / 4, tolerance);
  CHECK_NEAR(atan2_upper(T(1), T(-1)), 3 * pi<T> / 4, tolerance);
  CHECK(atan2_upper(T(1), T(-1e-30)) <= pi<T>);
  CHECK(std::isnan(atan2_upper(nan, T(1))) && std::isnan(atan2_upper(T(1), nan)));
  T s, c;
  sin_cos(T(0), s, c);
  CHECK(s == 0 && c == 1);
  sin_cos(pi<T> / 2, s, c);
  CHECK_NEAR(s, 1, tolerance);
  CHECK_NEAR(c, 0, tolerance);
  sin_cos(pi<T>, s, c);
  CHECK_NEAR(s, 0, tolerance);
  CHECK_NEAR(c, -1, tolerance);
  sin_cos(tiny, s, c);
  CHECK(s == tiny && c == 1);
  for (const T y : {T(0.3), T(1), T(4)}) {
    for (const T x : {T(-2), T(-0.1), T(0.7), T(3)}) {
      CHECK(atan2_signed(y, x) == atan2_upper(y, x) && atan2_signed(-y, x) == -atan2_upper(y, x));
      T s_below, c_below;
      sin_cos(y < pi<T> ? y : pi<T>, s, c);
      sin_cos_signed(-(y < pi<T> ? y : pi<T>), s_below, c_below);
      CHECK(s_below == -s && c_below == c);
    }
  }
  CHECK(std::isnan(atan2_signed(nan, T(1))) && std::isnan(atan2_signed(T(-1), nan)));
}

TEST(axes_and_diagonals_are_exact_to_rounding) {
  check_corners<float>();
  check_corners<double>();
}

// The branches meet at 45 and 135 degrees: no step may be larger than rounding allows.
TEST(float_atan2_does_not_jump_where_its_branches_meet) {
  for (const float x : {1.0f, -1.0f}) {
    const float below = atan2_upper(std::nextafter(1.0f, 0.0f), x), at = atan2_upper(1.0f, x),
                above = atan2_upper(std::nextafter(1.0f, 2.0f), x);
    CHECK_NEAR(below, at, 4 * epsilon);
    CHECK_NEAR(above, at, 4 * epsilon);
  }
}

TEST(vectors_of_angles_are_angles) {
  using T = VectorOf<float, 8>::type;
  std::mt19937_64 random(3);
  std::normal_distribution<float> normal;
  for (int repeat = 0; repeat < 5000; ++repeat) {
    float y[8], x[8];
    for (int lane = 0; lane < 8; ++lane) {
      y[lane] = repeat % 7 == lane ? 0 : std::abs(normal(random)), x[lane] = repeat % 5 == lane ? 0 : normal(random);
    }
    const T theta = atan2_upper(load_lanes<T>(y), load_lanes<T>(x));
    T s, c;
    sin_cos(theta, s, c);
    for (int lane = 0; lane < 8; ++lane) {
      const float angle = theta[lane];
      float sine, cosine;
      sin_cos(angle, sine, cosine);
      CHECK_NEAR(angle, atan2_upper(y[lane], x[lane]), epsilon * angle);
      CHECK_NEAR(s[lane], sine, epsilon);
      CHECK_NEAR(c[lane], cosine, epsilon);
    }
  }
}
