#include "../geometry/kannala_brandt.h"

#include <algorithm>
#include <random>

#include "cameras.h"
#include "check.h"
#include "derivative.h"

using namespace fisheyerec;
using Lens = KannalaBrandt<double>;

namespace {

constexpr double degree = pi<double> / 180;

double normalized_distance(const NamedCamera& camera, const Pixel<double>& pixel) {
  const double* p = camera.params;
  return std::hypot((pixel.x - p[2]) / p[0], (pixel.y - p[3]) / p[1]);
}

// visit(pixel) over a grid that reaches a little beyond the frame.
template <class Visit>
void for_each_pixel(const NamedCamera& camera, const Visit& visit) {
  constexpr int steps = 24;
  for (int row = -1; row <= steps + 1; ++row) {
    for (int column = -1; column <= steps + 1; ++column) {
      visit(Pixel<double>{(camera.width - 1) * column / double(steps), (camera.height - 1) * row / double(steps)});
    }
  }
}

Ray<double> ray_at(double theta, double azimuth, double length) {
  const double radial = length * std::sin(theta);
  return {radial * std::cos(azimuth), radial * std::sin(azimuth), length * std::cos(theta)};
}

// The scale on which this lens' curve bends: a telephoto's k4 = -8.5e10 acts within hundredths of a radian.
double curve_scale(const Lens& lens) { return std::min({1.0, lens.theta_max, lens.theta_d_max}); }

struct Quartic {  // theta_d' as a function of u = theta^2
  long double c[5];

  explicit Quartic(const double k[4]) : c{1, 3.0L * k[0], 5.0L * k[1], 7.0L * k[2], 9.0L * k[3]} {}
  long double operator()(long double u) const { return c[0] + u * (c[1] + u * (c[2] + u * (c[3] + u * c[4]))); }
  // The size of the terms, to which rounding is relative.
  long double size(long double u) const {
    return 1 + u * (std::abs(c[1]) + u * (std::abs(c[2]) + u * (std::abs(c[3]) + u * std::abs(c[4]))));
  }
};

void check_monotonic_limit(const double k[4]) {
  constexpr double u_max = pi<double> * pi<double>;
  constexpr int samples = 1500;
  const Quartic slope(k);
  const double limit = monotonic_limit(k), u_limit = limit * limit;
  CHECK(limit > 0 && limit <= pi<double>);
  for (int i = 0; i <= samples; ++i) {
    const double u = u_max * i / samples;
    if (u < u_limit * (1 - 1e-9)) {
      CHECK(slope(u) >= -1e-13L * slope.size(u));
    } else if (u > u_limit * (1 + 1e-9)) {
      break;
    }
  }
  if (limit < pi<double>) CHECK_NEAR(slope(u_limit) / slope.size(u_limit), 0, 1e-12);
}

}  // namespace

TEST(the_axis_meets_the_principal_point) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    Pixel<double> pixel;
    CHECK(lens.project({0, 0, 2}, pixel));
    CHECK(pixel.x == camera.params[2] && pixel.y == camera.params[3]);
    CHECK(!lens.project({0, 0, 0}, pixel));
    CHECK(!lens.project({0, 0, -1}, pixel));
    Ray<double> ray;
    CHECK(lens.unproject({camera.params[2], camera.params[3]}, ray));
    CHECK(ray.x == 0 && ray.y == 0 && ray.z == 1);
  }
}

TEST(an_equidistant_lens_maps_angles_to_distances) {
  const double params[8] = {100, 200, 10, 20, 0, 0, 0, 0};
  const Lens lens = Lens::make(params);
  CHECK(lens.theta_max == pi<double>);
  for (const double theta : {1e-9, 0.5, 1.5, pi<double> / 2, 2.0, 3.0}) {
    Pixel<double> pixel;
    CHECK(lens.project(ray_at(theta, 0.3, 7), pixel));
    CHECK_NEAR(pixel.x, 10 + 100 * theta * std::cos(0.3), 1e-12);
    CHECK_NEAR(pixel.y, 20 + 200 * theta * std::sin(0.3), 1e-12);
  }
}

TEST(pixels_come_back_from_their_rays) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    int seen = 0, beyond = 0;
    for_each_pixel(camera, [&](const Pixel<double>& pixel) {
      const double distance = normalized_distance(camera, pixel);
      Ray<double> ray;
      const bool valid = lens.unproject(pixel, ray);
      if (std::abs(distance - lens.theta_d_max) > 1e-12 * lens.theta_d_max)
        CHECK(valid == (distance < lens.theta_d_max));
      beyond += !valid;
      if (!valid) return;
      ++seen;
      CHECK_NEAR(ray.x * ray.x + ray.y * ray.y + ray.z * ray.z, 1, 1e-14);
      // Landing exactly on theta_max, a ray may round to the far side of it.
      if (distance > lens.theta_d_max * (1 - 1e-9)) return;
      Pixel<double> back;
      CHECK(lens.project({3 * ray.x, 3 * ray.y, 3 * ray.z}, back));
      CHECK_NEAR(back.x, pixel.x, 1e-10);
      CHECK_NEAR(back.y, pixel.y, 1e-10);
    });
    CHECK(seen > 100);
    CHECK(beyond > 0 || !camera.folds_in_frame);
  }
}

TEST(rays_come_back_from_their_pixels_up_to_the_limit_and_not_beyond) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    for (int i = 1; i < 400; ++i) {
      const double theta = pi<double> * i / 400 * (i % 2 ? 1 : std::min(1.0, 1.2 * lens.theta_max / pi<double>));
      const Ray<double> ray = ray_at(theta, 0.1 * i, 0.5);
      Pixel<double> pixel;
      const bool valid = lens.project(ray, pixel);
      CHECK(valid == (theta <= lens.theta_max));
      if (!valid) continue;
      Ray<double> back;
      CHECK(lens.unproject(pixel, back));
      // A pixel known to p pixels tells theta to p / (f theta_d'): little, near the limit.
      const double rounding = 4e-16 * (std::abs(pixel.x) + std::abs(pixel.y)) / std::abs(camera.params[0]) + 4e-16;
      const double tolerance = 1e-14 + 8 * rounding / std::max(lens.theta_d_derivative(theta), 1e-9);
      CHECK_NEAR(back.x, 2 * ray.x, tolerance);
      CHECK_NEAR(back.y, 2 * ray.y, tolerance);
      CHECK_NEAR(back.z, 2 * ray.z, tolerance);
    }
  }
}

TEST(rays_beyond_90_degrees_are_ordinary) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    if (lens.theta_max < 100 * degree) continue;
    const double radius = camera.params[0] * lens.theta_d(99 * degree);
    Ray<double> ray;
    CHECK(lens.unproject({camera.params[2] + radius, camera.params[3]}, ray));
    CHECK_NEAR(ray.z, std::cos(99 * degree), 1e-13);
  }
}

template <class T>
void check_inverse(double tolerance) {
  constexpr T infinity = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN();
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const auto lens = KannalaBrandt<T>::make(camera.params);
    const Lens exact = Lens::make(camera.params);
    const auto look = [&](T distance) {
      const auto inverse = lens.theta_from_theta_d(distance);
      CHECK(inverse.converged);
      CHECK(inverse.theta >= 0 && inverse.theta <= lens.theta_max);
      CHECK_NEAR(exact.theta_d(static_cast<double>(inverse.theta)), distance,
                 tolerance * (static_cast<double>(distance) + std::min(1.0, exact.theta_d_max)));
    };
    for (int i = 0; i < 20000; ++i) look(lens.theta_d_max * static_cast<T>(i / 20000.0));
    // What a frame sees of a lens whose theta_d(pi) is in the hundreds.
    const T in_frame = std::min(T(2), lens.theta_d_max);
    for (int i = 0; i < 20000; ++i) look(in_frame * static_cast<T>(i / 20000.0));
    for (int i = 1; i < 16; ++i) {
      const T rim = lens.theta_d_max * (1 - static_cast<T>(std::pow(10.0, -i)));
      if (rim < lens.theta_d_max) look(rim);
    }
    look(lens.theta_d_max);
    look(std::numeric_limits<T>::denorm_min());
    for (const T outside : {T(-1e-30), T(-1), -infinity, std::nextafter(lens.theta_d_max, infinity),
                            lens.theta_d_max * 2, infinity, nan}) {
      const auto inverse = lens.theta_from_theta_d(outside);
      CHECK(!inverse.converged);
      CHECK(inverse.theta >= 0 && inverse.theta <= lens.theta_max);
    }
  }
}

TEST(the_inverse_converges_exactly_within_its_range_in_double) { check_inverse<double>(1e-14); }
TEST(the_inverse_converges_exactly_within_its_range_in_float) { check_inverse<float>(2e-6); }

TEST(the_inverse_of_random_lenses_converges) {
  std::mt19937_64 random(5);
  std::normal_distribution<double> normal;
  for (int repeat = 0; repeat < 3000; ++repeat) {
    double params[8] = {1, 1, 0, 0};
    const double size = std::exp2(repeat % 12 - 6);
    for (int i = 0; i < 4; ++i) params[4 + i] = size * normal(random);
    const Lens lens = Lens::make(params);
    for (int i = 0; i <= 200; ++i) {
      const double distance = lens.theta_d_max * (i / 200.0);
      const auto inverse = lens.theta_from_theta_d(distance);
      CHECK(inverse.converged);
      CHECK_NEAR(lens.theta_d(inverse.theta), distance, 1e-14 * (1 + lens.theta_d_max));
    }
  }
}

TEST(a_camera_made_of_any_parameters_answers_invalid_at_worst) {
  constexpr double infinity = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  for (const double value : {0.0, 1e-300, 1e30, 1e300, -1e300, 1e308, -1.7e308, infinity, -infinity, nan}) {
    for (int i = 0; i < 8; ++i) {
      for (int j = 0; j < 8; ++j) {
        double params[8] = {300, 300, 320, 240, 0.1, 0, 0, 0};
        params[i] = value, params[j] = -value;
        const Lens lens = Lens::make(params);
        const auto narrow = KannalaBrandt<float>::make(params);
        for (const double at : {0.0, 320.0, 1e30, infinity, nan}) {
          Ray<double> ray;
          Ray<float> narrow_ray;
          if (lens.unproject({at, 5}, ray)) CHECK(ray.z >= -1 && ray.z <= 1);
          if (narrow.unproject({static_cast<float>(at), 5}, narrow_ray)) CHECK(narrow_ray.z >= -1 && narrow_ray.z <= 1);
        }
      }
    }
  }
}

TEST(monotonic_limit_is_the_first_extremum) {
  std::mt19937_64 random(6);
  std::normal_distribution<double> normal;
  int folding = 0;
  for (int repeat = 0; repeat < 4000; ++repeat) {
    double k[4];
    // Coefficients that matter somewhere within pi, some far before, some hardly at all.
    for (int i = 0; i < 4; ++i)
      k[i] = normal(random) * std::exp2(repeat % 9 - 3) * std::pow(pi<double> / 2, -2 * (i + 1));
    check_monotonic_limit(k);
    folding += monotonic_limit(k) < pi<double>;
  }
  CHECK(folding > 1000 && folding < 3900);
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    check_monotonic_limit(camera.params + 4);
  }
}

// theta_d' = (1 - u/a)(1 - u/b)(1 - u/c)(1 - u/d): the smallest of the four is the limit, however close the others.
TEST(monotonic_limit_finds_the_first_of_four_roots) {
  std::mt19937_64 random(7);
  std::uniform_real_distribution<double> uniform(0.3, 9.5);
  for (int repeat = 0; repeat < 2000; ++repeat) {
    double roots[4], elementary[5] = {1, 0, 0, 0, 0};
    for (double& root : roots) root = uniform(random);
    for (const double root : roots) {
      for (int i = 4; i > 0; --i) elementary[i] -= elementary[i - 1] / root;
    }
    const double k[4] = {elementary[1] / 3, elementary[2] / 5, elementary[3] / 7, elementary[4] / 9};
    std::sort(roots, roots + 4);
    if (roots[1] - roots[0] < 0.01) continue;
    CHECK_NEAR(monotonic_limit(k), std::sqrt(roots[0]), 1e-9);
  }
}

TEST(monotonic_limit_of_special_lenses) {
  constexpr double infinity = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  const auto limit = [](double k1, double k2, double k3, double k4) {
    const double k[4] = {k1, k2, k3, k4};
    return monotonic_limit(k);
  };
  CHECK(limit(0, 0, 0, 0) == pi<double>);
  CHECK(limit(1, 1, 1, 1) == pi<double>);
  CHECK_NEAR(limit(-1.0 / 3, 0, 0, 0), 1, 1e-15);
  CHECK_NEAR(limit(0, -1.0 / 5, 0, 0), 1, 1e-15);
  CHECK_NEAR(limit(0, 0, -1.0 / 7, 0), 1, 1e-15);
  CHECK_NEAR(limit(0, 0, 0, -1.0 / 9), 1, 1e-15);
  CHECK_NEAR(limit(-1e6 / 3, 0, 0, 0), 1e-3, 1e-17);
  CHECK(limit(nan, 0, 0, 0) == 0);
  CHECK(limit(0, infinity, 0, 0) == 0);
  CHECK(limit(0, 0, 0, -infinity) == 0);
}

TEST(project_adjoint_matches_differences) {
  std::mt19937_64 random(8);
  std::normal_distribution<double> normal;
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    const double scale = curve_scale(lens);
    // From a hundred-millionth of a radian off the axis over the image plane to the limit.
    for (const double part : {1e-8, 1e-5, 1e-3, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0}) {
      const double theta = std::min(part * lens.theta_max, 3.0);
      for (int turn = 0; turn < 8; ++turn) {
        const double length = std::exp2(turn - 4);
        const Ray<double> direction = ray_at(theta, 0.7 * turn, length);
        double ray[3] = {direction.x, direction.y, direction.z}, params[8];
        std::copy(camera.params, camera.params + 8, params);
        const Pixel<double> g{normal(random), normal(random)};
        const auto loss = [&] {
          Pixel<double> pixel;
          Lens::make(params).project({ray[0], ray[1], ray[2]}, pixel);
          return g.x * (pixel.x - camera.params[2]) + g.y * (pixel.y - camera.params[3]);
        };
        Ray<double> grad_ray{1, 2, 3};
        double grad_params[8] = {4, 5, 6, 7, 8, 9, 10, 11};
        lens.project_adjoint(direction, g, grad_ray, grad_params);
        const double grads[3] = {grad_ray.x - 1, grad_ray.y - 2, grad_ray.z - 3};
        // The direction -z is a singularity, from which differences must keep away.
        const double step = 0.005 * length * std::min(scale, pi<double> - theta);
        for (int i = 0; i < 3; ++i) {
          const Derivative d = derivative(loss, ray[i], step);
          CHECK_NEAR(grads[i], d.value, 1e-8 * std::abs(camera.params[0]) / length + d.rounding);
        }
        for (int i = 0; i < 8; ++i) {
          const Derivative d =
              derivative(loss, params[i], i < 4 ? 1.0 : 0.01 / std::pow(std::max(theta, 1e-3), 2 * i - 5));
          CHECK_NEAR(grad_params[i] - (4 + i), d.value, 1e-9 * (1 + std::abs(d.value)) + d.rounding);
        }
      }
    }
  }
}

TEST(unproject_adjoint_matches_differences) {
  std::mt19937_64 random(9);
  std::normal_distribution<double> normal;
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    for (const double part : {1e-8, 1e-5, 1e-3, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.9999}) {
      const double theta = std::min(part * lens.theta_max, 2.5), distance = lens.theta_d(theta);
      for (int turn = 0; turn < 8; ++turn) {
        double params[8];
        std::copy(camera.params, camera.params + 8, params);
        const Pixel<double> pixel{params[2] + params[0] * distance * std::cos(0.7 * turn),
                                  params[3] + params[1] * distance * std::sin(0.7 * turn)};
        const Ray<double> g{normal(random), normal(random), normal(random)};
        const auto loss = [&] {
          Ray<double> ray;
          Lens::make(params).unproject(pixel, ray);
          return g.x * ray.x + g.y * ray.y + g.z * ray.z;
        };
        double grad_params[8] = {4, 5, 6, 7, 8, 9, 10, 11};
        lens.unproject_adjoint(pixel, g, grad_params);
        // Every parameter moves theta_d by a small part of the way to where the inverse is singular: the limit, or
        // an inflection where the slope almost vanishes.
        const double slope = lens.theta_d_derivative(theta);
        const double move = 0.001 * std::min({curve_scale(lens), lens.theta_d_max - distance, slope * slope});
        const double reach = std::max(theta, curve_scale(lens));
        const double moved_by[8] = {distance / std::abs(params[0]),
                                    distance / std::abs(params[1]),
                                    1 / std::abs(params[0]),
                                    1 / std::abs(params[1]),
                                    std::pow(reach, 3),
                                    std::pow(reach, 5),
                                    std::pow(reach, 7),
                                    std::pow(reach, 9)};
        for (int i = 0; i < 8; ++i) {
          const double step = std::min(move / moved_by[i], i < 2 ? 0.005 * std::abs(params[i]) : 1e30);
          const Derivative d = derivative(loss, params[i], step);
          // An inverse known to epsilon / theta_d' makes noisy differences near the limit.
          const double noise = 4e-15 * std::max(1.0, 1 / slope) * (1 + distance) / step;
          CHECK_NEAR(grad_params[i] - (4 + i), d.value, 1e-8 * std::abs(d.value) + d.rounding + noise + 4e-15);
        }
      }
    }
  }
}

TEST(adjoints_on_the_axis_are_the_limit_of_those_beside_it) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    Ray<double> on{0, 0, 0}, beside{0, 0, 0};
    double grad_on[8] = {}, grad_beside[8] = {};
    lens.project_adjoint({0, 0, 2}, {1, 2}, on, grad_on);
    lens.project_adjoint({1e-9, 1e-9, 2}, {1, 2}, beside, grad_beside);
    CHECK_NEAR(on.x, camera.params[0] / 2, 1e-12);
    CHECK_NEAR(on.y, camera.params[1], 1e-12);
    CHECK_NEAR(on.x, beside.x, 1e-6 * std::abs(on.x));
    CHECK_NEAR(on.y, beside.y, 1e-6 * std::abs(on.y));
    CHECK_NEAR(on.z, beside.z, 1e-4);
    for (int i = 0; i < 8; ++i) CHECK_NEAR(grad_on[i], grad_beside[i], 1e-6);

    double unproject_on[8] = {}, unproject_beside[8] = {};
    const double cx = camera.params[2], cy = camera.params[3];
    lens.unproject_adjoint({cx, cy}, {1, 2, 3}, unproject_on);
    lens.unproject_adjoint({cx + 1e-7, cy + 1e-7}, {1, 2, 3}, unproject_beside);
    CHECK_NEAR(unproject_on[2], -1 / camera.params[0], 1e-15);
    CHECK_NEAR(unproject_on[3], -2 / camera.params[1], 1e-15);
    for (int i = 0; i < 8; ++i) CHECK_NEAR(unproject_on[i], unproject_beside[i], 1e-8);
  }
}

// A central projection does not care how long a ray is.
TEST(the_gradient_to_a_ray_is_orthogonal_to_it) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    for (int i = 1; i < 40; ++i) {
      const Ray<double> ray = ray_at(lens.theta_max * i / 40, i, 1);
      Ray<double> grad{0, 0, 0};
      double grad_params[8] = {};
      lens.project_adjoint(ray, {1, -2}, grad, grad_params);
      const double size = std::hypot(grad.x, grad.y, grad.z);
      CHECK_NEAR(grad.x * ray.x + grad.y * ray.y + grad.z * ray.z, 0, 1e-13 * size);
    }
  }
}

TEST(float_agrees_with_double) {
  constexpr double epsilon = std::numeric_limits<float>::epsilon();
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const Lens lens = Lens::make(camera.params);
    const auto narrow = KannalaBrandt<float>::make(camera.params);
    for (int i = 0; i < 2000; ++i) {
      const double theta = std::min(lens.theta_max * 0.999, 2.2) * i / 2000;
      const Ray<double> ray = ray_at(theta, i, 1);
      const Ray<float> narrow_ray{static_cast<float>(ray.x), static_cast<float>(ray.y), static_cast<float>(ray.z)};
      Pixel<double> pixel;
      Pixel<float> narrow_pixel;
      CHECK(lens.project({narrow_ray.x, narrow_ray.y, narrow_ray.z}, pixel));
      CHECK(narrow.project(narrow_ray, narrow_pixel));
      const double focal = std::abs(camera.params[0]);
      // theta carries a relative error of a few epsilon, which theta_d' passes on.
      const double tolerance =
          epsilon *
          (std::abs(pixel.x) + std::abs(pixel.y) +
           2 * focal * (std::abs(lens.theta_d(theta)) + 4 * theta * std::abs(lens.theta_d_derivative(theta))) + 1);
      CHECK_NEAR(narrow_pixel.x, pixel.x, tolerance);
      CHECK_NEAR(narrow_pixel.y, pixel.y, tolerance);

      Ray<double> grad{0, 0, 0};
      Ray<float> narrow_grad{0, 0, 0};
      double grads[8] = {};
      float narrow_grads[8] = {};
      lens.project_adjoint({narrow_ray.x, narrow_ray.y, narrow_ray.z}, {1, -2}, grad, grads);
      narrow.project_adjoint(narrow_ray, {1, -2}, narrow_grad, narrow_grads);
      const double size = 3 * focal * (1 + std::abs(lens.theta_d_derivative(theta)));
      CHECK_NEAR(narrow_grad.x, grad.x, 1e-5 * size);
      CHECK_NEAR(narrow_grad.y, grad.y, 1e-5 * size);
      CHECK_NEAR(narrow_grad.z, grad.z, 1e-5 * size);
      for (int j = 0; j < 8; ++j)
        CHECK_NEAR(narrow_grads[j], grads[j],
                   1e-5 * (std::abs(grads[j]) + 3 * focal * std::pow(theta, std::max(0, 2 * j - 5))));
    }
  }
}

TEST(vectors_of_pixels_are_unprojected_like_single_ones) {
  using T = VectorOf<float, 8>::type;
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const auto lens = KannalaBrandt<float>::make(camera.params);
    for_each_pixel(camera, [&](const Pixel<double>& pixel) {
      Pixel<T> pixels{splat<T>(pixel.x), splat<T>(pixel.y)};
      for (int lane = 0; lane < 8; ++lane) pixels.x[lane] += static_cast<float>(100 * lane);
      Ray<T> rays;
      const Mask<T> valid = lens.unproject(pixels, rays);
      for (int lane = 0; lane < 8; ++lane) {
        Ray<float> ray;
        CHECK((valid[lane] != 0) == lens.unproject(Pixel<float>{pixels.x[lane], pixels.y[lane]}, ray));
        if (!valid[lane]) continue;
        CHECK_NEAR(rays.x[lane], ray.x, 1e-5);
        CHECK_NEAR(rays.y[lane], ray.y, 1e-5);
        CHECK_NEAR(rays.z[lane], ray.z, 1e-5);
      }
    });
  }
}
