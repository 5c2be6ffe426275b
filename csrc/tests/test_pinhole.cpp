#include "../geometry/pinhole.h"

#include <random>

#include "check.h"
#include "derivative.h"

using namespace fisheyerec;

namespace {

constexpr double views[][4] = {{400, 400, 319.5, 239.5}, {150, 600, -20, 1000}, {-300, 250, 0, 0}};

}  // namespace

TEST(the_axis_meets_the_principal_point) {
  for (const auto& view : views) {
    Pixel<double> pixel;
    CHECK(Pinhole<double>::make(view).project({0, 0, 3}, pixel));
    CHECK(pixel.x == view[2] && pixel.y == view[3]);
  }
}

TEST(a_ray_at_45_degrees_lands_one_focal_length_from_the_centre) {
  Pixel<double> pixel;
  CHECK(Pinhole<double>::make(views[0]).project({2, -2, 2}, pixel));
  CHECK(pixel.x == 719.5 && pixel.y == -160.5);
}

TEST(pixels_come_back_from_their_rays) {
  for (const auto& view : views) {
    const auto camera = Pinhole<double>::make(view);
    for (double y = -100; y <= 1000; y += 99.7) {
      for (double x = -100; x <= 1000; x += 99.7) {
        Ray<double> ray;
        Pixel<double> pixel;
        CHECK(camera.unproject({x, y}, ray));
        CHECK(camera.project({5 * ray.x, 5 * ray.y, 5 * ray.z}, pixel));
        CHECK_NEAR(pixel.x, x, 1e-11);
        CHECK_NEAR(pixel.y, y, 1e-11);
      }
    }
  }
}

TEST(rays_on_or_behind_the_image_plane_are_invalid) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  const auto camera = Pinhole<double>::make(views[0]);
  Pixel<double> pixel;
  for (const double z : {0.0, -0.0, -1.0, -1e300, nan}) CHECK(!camera.project({1, 1, z}, pixel));
}

TEST(project_adjoint_matches_differences) {
  std::mt19937_64 random(3);
  std::normal_distribution<double> normal;
  for (const auto& view : views) {
    for (int repeat = 0; repeat < 50; ++repeat) {
      double params[4], ray[3] = {normal(random), normal(random), 0.2 + std::abs(normal(random))};
      std::copy(view, view + 4, params);
      const Pixel<double> g{normal(random), normal(random)};
      const auto loss = [&] {
        Pixel<double> pixel;
        Pinhole<double>::make(params).project({ray[0], ray[1], ray[2]}, pixel);
        return g.x * pixel.x + g.y * pixel.y;
      };
      Ray<double> grad_ray{1, 2, 3};
      double grad_params[4] = {4, 5, 6, 7};
      Pinhole<double>::make(params).project_adjoint({ray[0], ray[1], ray[2]}, g, grad_ray, grad_params);
      const double grads[3] = {grad_ray.x - 1, grad_ray.y - 2, grad_ray.z - 3};
      for (int i = 0; i < 3; ++i) {
        const Derivative d = derivative(loss, ray[i], 0.005 * ray[2]);
        CHECK_NEAR(grads[i], d.value, 1e-9 * std::abs(d.value) + d.rounding);
      }
      for (int i = 0; i < 4; ++i) {
        const Derivative d = derivative(loss, params[i], 1.0);
        CHECK_NEAR(grad_params[i] - (4 + i), d.value, 1e-9 * std::abs(d.value) + d.rounding + 1e-13);
      }
    }
  }
}

TEST(unproject_adjoint_matches_differences) {
  std::mt19937_64 random(4);
  std::normal_distribution<double> normal;
  for (const auto& view : views) {
    for (int repeat = 0; repeat < 50; ++repeat) {
      double params[4];
      std::copy(view, view + 4, params);
      const Pixel<double> pixel{300 * normal(random), 300 * normal(random)};
      const Ray<double> g{normal(random), normal(random), normal(random)};
      const auto loss = [&] {
        Ray<double> ray;
        Pinhole<double>::make(params).unproject(pixel, ray);
        return g.x * ray.x + g.y * ray.y + g.z * ray.z;
      };
      double grad_params[4] = {4, 5, 6, 7};
      Pinhole<double>::make(params).unproject_adjoint(pixel, g, grad_params);
      for (int i = 0; i < 4; ++i) {
        const Derivative d = derivative(loss, params[i], 0.5);
        CHECK_NEAR(grad_params[i] - (4 + i), d.value, 1e-9 * std::abs(d.value) + d.rounding + 4e-15);
      }
    }
  }
}
