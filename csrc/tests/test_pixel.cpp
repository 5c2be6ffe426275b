#include "../geometry/pixel.h"

#include <limits>
#include <random>

#include "check.h"

using namespace fisheyerec;

namespace {

template <class T>
void check_inside() {
  constexpr T infinity = std::numeric_limits<T>::infinity();
  for (const int size : {1, 2, 3, 640}) {
    const T low = T(-0.5), high = static_cast<T>(size) - T(0.5);
    CHECK(inside(low, static_cast<T>(size)));
    CHECK(inside(high, static_cast<T>(size)));
    CHECK(inside(T(0), static_cast<T>(size)));
    CHECK(!inside(std::nextafter(low, -infinity), static_cast<T>(size)));
    CHECK(!inside(std::nextafter(high, infinity), static_cast<T>(size)));
    CHECK(!inside(infinity, static_cast<T>(size)));
    CHECK(!inside(-infinity, static_cast<T>(size)));
    CHECK(!inside(std::numeric_limits<T>::quiet_NaN(), static_cast<T>(size)));
  }
}

template <class T>
void check_nearest() {
  for (const int size : {1, 2, 3, 640}) {
    for (int i = 0; i < size; ++i) {
      CHECK(nearest_index(static_cast<T>(i)) == i);
      CHECK(nearest_index(static_cast<T>(i) - T(0.5)) == i);
      CHECK(nearest_index(static_cast<T>(i) + T(0.499)) == i);
    }
  }
}

}  // namespace

TEST(an_image_spans_half_a_pixel_beyond_its_outer_centres) {
  check_inside<float>();
  check_inside<double>();
}

TEST(a_pixel_owns_the_coordinates_around_its_centre) {
  check_nearest<float>();
  check_nearest<double>();
}

TEST(a_quarter_turn_takes_x_to_y_and_y_to_minus_x) {
  const double R[9] = {0, -1, 0, 1, 0, 0, 0, 0, 1};
  const Ray<double> x = rotate(R, Ray<double>{1, 0, 0}), y = rotate(R, Ray<double>{0, 1, 0}),
                    oblique = rotate(R, Ray<double>{1, 2, 3});
  CHECK(x.x == 0 && x.y == 1 && x.z == 0);
  CHECK(y.x == -1 && y.y == 0 && y.z == 0);
  CHECK(oblique.x == -2 && oblique.y == 1 && oblique.z == 3);
}

// rotate is linear in the ray and in R: <g, R ray> = <grad_ray, ray> = <grad_R, R>.
TEST(rotate_adjoint_is_the_transpose_and_accumulates) {
  std::mt19937_64 random(1);
  std::normal_distribution<double> normal;
  for (int repeat = 0; repeat < 100; ++repeat) {
    double R[9], grad_R[9], start[9];
    for (int i = 0; i < 9; ++i) R[i] = normal(random), start[i] = grad_R[i] = normal(random);
    const Ray<double> ray{normal(random), normal(random), normal(random)};
    const Ray<double> g{normal(random), normal(random), normal(random)};
    const Ray<double> other{normal(random), normal(random), normal(random)};
    Ray<double> grad_ray{1, 2, 3};
    rotate_adjoint(R, ray, g, grad_ray, grad_R);
    const Ray<double> moved = rotate(R, other), rotated = rotate(R, ray);
    CHECK_NEAR((grad_ray.x - 1) * other.x + (grad_ray.y - 2) * other.y + (grad_ray.z - 3) * other.z,
               g.x * moved.x + g.y * moved.y + g.z * moved.z, 1e-12);
    double along_R = 0;
    for (int i = 0; i < 9; ++i) along_R += (grad_R[i] - start[i]) * R[i];
    CHECK_NEAR(along_R, g.x * rotated.x + g.y * rotated.y + g.z * rotated.z, 1e-12);
    CHECK_NEAR(grad_R[5] - start[5], g.y * ray.z, 1e-12);
  }
}
