// The views beside the pinhole: cylindrical, equirectangular, stereographic and Panini.
#include <random>

#include "../geometry/cylindrical.h"
#include "../geometry/equirectangular.h"
#include "../geometry/panini.h"
#include "../geometry/pinhole.h"
#include "../geometry/stereographic.h"
#include "check.h"
#include "derivative.h"

using namespace fisheyerec;

namespace {

// fx, fy, cx, cy and Panini's d.
constexpr double views[][5] = {{400, 400, 319.5, 239.5, 1}, {150, 600, -20, 1000, 0.5}, {-300, 250, 0, 0, 0.1}};
constexpr double panini_far[5] = {400, 400, 319.5, 239.5, 3};

// Calls visit with each model of these parameters.
template <class S = double, class Visit>
void for_each_model(const double* params, const Visit& visit) {
  check::subject = "cylindrical";
  visit(Cylindrical<S>::make(params));
  check::subject = "equirectangular";
  visit(Equirectangular<S>::make(params));
  check::subject = "stereographic";
  visit(Stereographic<S>::make(params));
  check::subject = "Panini";
  visit(Panini<S>::make(params));
}

double angle_between(const Ray<double>& a, const Ray<double>& b) {
  const Ray<double> c{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
  return std::atan2(std::sqrt(c.x * c.x + c.y * c.y + c.z * c.z), a.x * b.x + a.y * b.y + a.z * b.z);
}

Ray<double> ray_at(double longitude, double latitude) {
  return {std::cos(latitude) * std::sin(longitude), std::sin(latitude), std::cos(latitude) * std::cos(longitude)};
}

}  // namespace

TEST(the_axis_meets_the_principal_point_and_the_slope_there_is_the_focal_length) {
  for (const auto& view : views) {
    for_each_model(view, [&](const auto& camera) {
      Pixel<double> pixel;
      CHECK(camera.project(Ray<double>{0, 0, 3}, pixel));
      CHECK(pixel.x == view[2] && pixel.y == view[3]);
      CHECK(camera.project(Ray<double>{1e-5, -2e-5, 1}, pixel));
      CHECK_NEAR((pixel.x - view[2]) / view[0], 1e-5, 1e-12);
      CHECK_NEAR((pixel.y - view[3]) / view[1], -2e-5, 1e-12);
    });
  }
}

TEST(rays_come_back_from_their_pixels) {
  for (const auto& view : views) {
    for_each_model(view, [&](const auto& camera) {
      int seen = 0;
      for (double longitude = -3.1; longitude <= 3.1; longitude += 0.31) {
        for (double latitude = -1.5; latitude <= 1.5; latitude += 0.15) {
          const Ray<double> ray = ray_at(longitude, latitude);
          Pixel<double> pixel;
          Ray<double> back;
          if (!camera.project({3 * ray.x, 3 * ray.y, 3 * ray.z}, pixel)) continue;
          ++seen;
          CHECK(camera.unproject(pixel, back));
          CHECK_NEAR(angle_between(ray, back), 0, 1e-12);
        }
      }
      CHECK(seen > 200);
    });
  }
}

TEST(pixels_come_back_from_their_rays) {
  for (const auto& view : views) {
    for_each_model(view, [&](const auto& camera) {
      for (double v = -1.5; v <= 1.5; v += 0.1234) {
        for (double u = -3.1; u <= 3.1; u += 0.1234) {
          const Pixel<double> pixel{view[0] * u + view[2], view[1] * v + view[3]};
          Ray<double> ray;
          Pixel<double> back;
          CHECK(camera.unproject(pixel, ray));
          CHECK(camera.project({5 * ray.x, 5 * ray.y, 5 * ray.z}, back));
          CHECK_NEAR(back.x, pixel.x, 1e-11 * std::abs(view[0]));
          CHECK_NEAR(back.y, pixel.y, 1e-11 * std::abs(view[1]));
        }
      }
    });
  }
}

TEST(columns_of_the_cylinder_and_both_axes_of_the_equirectangular_view_are_angles) {
  const double* view = views[0];
  for (double longitude = -3; longitude <= 3; longitude += 0.5) {
    for (double latitude = -1.4; latitude <= 1.4; latitude += 0.2) {
      Pixel<double> pixel;
      CHECK(Cylindrical<double>::make(view).project(ray_at(longitude, latitude), pixel));
      CHECK_NEAR(pixel.x, view[2] + view[0] * longitude, 1e-10);
      CHECK_NEAR(pixel.y, view[3] + view[1] * std::tan(latitude), 1e-9);
      CHECK(Equirectangular<double>::make(view).project(ray_at(longitude, latitude), pixel));
      CHECK_NEAR(pixel.x, view[2] + view[0] * longitude, 1e-10);
      CHECK_NEAR(pixel.y, view[3] + view[1] * latitude, 1e-10);
    }
  }
}

TEST(the_middle_column_of_cylinder_and_panini_is_the_pinholes) {
  const double* view = views[0];
  for (double v = -4; v <= 4; v += 0.37) {
    const Pixel<double> pixel{view[2], view[3] + view[1] * v};
    Ray<double> ray;
    Pixel<double> seen;
    CHECK(Cylindrical<double>::make(view).unproject(pixel, ray));
    CHECK(Pinhole<double>::make(view).project(ray, seen));
    CHECK_NEAR(seen.x, pixel.x, 1e-10);
    CHECK_NEAR(seen.y, pixel.y, 1e-10);
    CHECK(Panini<double>::make(view).unproject(pixel, ray));
    CHECK(Pinhole<double>::make(view).project(ray, seen));
    CHECK_NEAR(seen.x, pixel.x, 1e-10);
    CHECK_NEAR(seen.y, pixel.y, 1e-10);
  }
}

TEST(panini_without_distance_is_the_pinhole) {
  double view[5];
  std::copy(views[0], views[0] + 4, view);
  view[4] = 0;
  for (double y = -1000; y <= 1000; y += 99.7) {
    for (double x = -1000; x <= 1000; x += 99.7) {
      Ray<double> ray;
      Pixel<double> seen;
      CHECK(Panini<double>::make(view).unproject({x, y}, ray));
      CHECK(Pinhole<double>::make(view).project(ray, seen));
      CHECK_NEAR(seen.x, x, 1e-10);
      CHECK_NEAR(seen.y, y, 1e-10);
    }
  }
}

TEST(panini_keeps_lines_to_the_middle_and_verticals_straight) {
  for (const auto& view : views) {
    const auto camera = Panini<double>::make(view);
    for (double slope = -2; slope <= 2; slope += 0.5) {
      for (double x = -5; x <= 5; x += 0.7) {
        Pixel<double> pixel;
        CHECK(camera.project({x, slope * x, 1}, pixel));  // on a line through the axis
        CHECK_NEAR((pixel.y - view[3]) / view[1], slope * (pixel.x - view[2]) / view[0], 1e-12 * (1 + std::abs(x)));
        Pixel<double> above;
        CHECK(camera.project({x, 7, 1}, above));  // on a vertical
        CHECK_NEAR(above.x, pixel.x, 1e-12 * std::abs(view[0]) * (1 + std::abs(x)));
      }
    }
  }
}

// u and v change by the same amount in any direction, and at right angles.
TEST(stereographic_keeps_small_shapes) {
  const double view[4] = {400, 400, 0, 0};
  const auto camera = Stereographic<double>::make(view);
  for (double longitude = -3; longitude <= 3; longitude += 0.5) {
    for (double latitude = -1.4; latitude <= 1.4; latitude += 0.2) {
      double at[2] = {longitude, latitude}, jacobian[2][2];
      for (int i = 0; i < 2; ++i) {
        for (int j = 0; j < 2; ++j) {
          jacobian[i][j] = derivative(
                               [&] {
                                 Pixel<double> pixel;
                                 CHECK(camera.project(ray_at(at[0], at[1]), pixel));
                                 return i == 0 ? pixel.x : pixel.y;
                               },
                               at[j], 1e-4)
                               .value;
        }
      }
      const double shrink = std::cos(latitude);  // of a step in longitude
      const double along = std::hypot(jacobian[0][0], jacobian[1][0]) / shrink;
      CHECK_NEAR(along, std::hypot(jacobian[0][1], jacobian[1][1]), 1e-6 * along);
      CHECK_NEAR(jacobian[0][0] * jacobian[0][1] + jacobian[1][0] * jacobian[1][1], 0, 1e-6 * along * along);
    }
  }
}

TEST(stereographic_keeps_its_digits_right_behind) {
  const double view[4] = {1, 1, 0, 0};
  Pixel<double> pixel;
  CHECK(Stereographic<double>::make(view).project({1e-9, 0, -1}, pixel));
  CHECK_NEAR(pixel.x, 4e9, 1e-5);  // 2 tan(theta / 2) = 4 / (pi - theta)
}

TEST(what_a_view_cannot_show_is_invalid) {
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  const double* view = views[0];
  Pixel<double> pixel;
  Ray<double> ray;
  for_each_model(view, [&](const auto& camera) {
    CHECK(!camera.project(Ray<double>{0, 0, 0}, pixel));
    CHECK(!camera.project(Ray<double>{nan, nan, nan}, pixel));
    CHECK(!camera.unproject(Pixel<double>{nan, 0}, ray));
  });
  CHECK(!Cylindrical<double>::make(view).project({0, 1, 0}, pixel));
  CHECK(!Cylindrical<double>::make(view).unproject({view[2] + 1.001 * pi<double> * view[0], 0}, ray));
  CHECK(Equirectangular<double>::make(view).project({0, 1, 0}, pixel));
  CHECK_NEAR(pixel.y, view[3] + view[1] * pi<double> / 2, 1e-10);
  CHECK(!Equirectangular<double>::make(view).unproject({view[2] - 1.001 * pi<double> * view[0], 0}, ray));
  CHECK(!Equirectangular<double>::make(view).unproject({0, view[3] + 1.001 * pi<double> / 2 * view[1]}, ray));
  CHECK(!Stereographic<double>::make(view).project({0, 0, -1}, pixel));
  CHECK(!Panini<double>::make(view).project({0, 0, -1}, pixel));
  CHECK(!Panini<double>::make(view).project({0, 1, 0}, pixel));
  // Seen from 3 behind the axis, u turns back at cos(lambda) = -1/3, where it is 4 / sqrt(8).
  const auto far = Panini<double>::make(panini_far);
  CHECK(far.project(ray_at(std::acos(-1.0 / 3) - 1e-6, 0), pixel));
  CHECK(!far.project(ray_at(std::acos(-1.0 / 3) + 1e-6, 0), pixel));
  CHECK(far.unproject({319.5 + 400 * 4 / std::sqrt(8.0) - 1e-6, 0}, ray));
  CHECK(!far.unproject({319.5 + 400 * 4 / std::sqrt(8.0) + 1e-6, 0}, ray));
  double negative[5];
  std::copy(view, view + 4, negative);
  negative[4] = -0.1;
  CHECK(!Panini<double>::make(negative).project({0, 0, 1}, pixel));
  CHECK(!Panini<double>::make(negative).unproject({view[2], view[3]}, ray));
}

TEST(project_adjoint_matches_differences) {
  std::mt19937_64 random(3);
  std::normal_distribution<double> normal;
  for (const auto& view : views) {
    for (int repeat = 0; repeat < 50; ++repeat) {
      double ray[3] = {normal(random), normal(random), normal(random)};
      const Pixel<double> g{normal(random), normal(random)};
      double params[5];
      std::copy(view, view + 5, params);
      for_each_model(params, [&](const auto& camera) {
        using Model = std::decay_t<decltype(camera)>;
        // Away from where a projection ends, no difference is a derivative.
        if (std::hypot(ray[0], ray[2]) < 0.5 || (ray[2] < 0 && std::abs(ray[0]) < 0.5)) return;
        if (Model::parameter_count == 5 && ray[2] < 0.2 * std::hypot(ray[0], ray[2])) return;
        const auto loss = [&] {
          Pixel<double> pixel{};
          Model::make(params).project(Ray<double>{ray[0], ray[1], ray[2]}, pixel);
          return g.x * pixel.x + g.y * pixel.y;
        };
        Ray<double> grad_ray{1, 2, 3};
        double grad_params[5] = {4, 5, 6, 7, 8};
        camera.project_adjoint(Ray<double>{ray[0], ray[1], ray[2]}, g, grad_ray, grad_params);
        const double grads[3] = {grad_ray.x - 1, grad_ray.y - 2, grad_ray.z - 3};
        for (int i = 0; i < 3; ++i) {
          const Derivative d = derivative(loss, ray[i], 0.002);
          CHECK_NEAR(grads[i], d.value, 1e-7 * (1 + std::abs(d.value)) + d.rounding);
        }
        for (int i = 0; i < Model::parameter_count; ++i) {
          const Derivative d = derivative(loss, params[i], i == 4 ? 0.002 : 1.0);
          CHECK_NEAR(grad_params[i] - (4 + i), d.value, 1e-8 * (1 + std::abs(d.value)) + d.rounding);
        }
      });
    }
  }
}

TEST(unproject_adjoint_matches_differences) {
  std::mt19937_64 random(4);
  std::normal_distribution<double> normal;
  for (const auto& view : views) {
    for (int repeat = 0; repeat < 50; ++repeat) {
      double params[5];
      std::copy(view, view + 5, params);
      const Pixel<double> pixel{300 * normal(random), 300 * normal(random)};
      const Ray<double> g{normal(random), normal(random), normal(random)};
      for_each_model(params, [&](const auto& camera) {
        using Model = std::decay_t<decltype(camera)>;
        const auto loss = [&] {
          Ray<double> ray;
          Model::make(params).unproject(pixel, ray);
          return g.x * ray.x + g.y * ray.y + g.z * ray.z;
        };
        double grad_params[5] = {4, 5, 6, 7, 8};
        camera.unproject_adjoint(pixel, g, grad_params);
        for (int i = 0; i < Model::parameter_count; ++i) {
          const Derivative d = derivative(loss, params[i], i == 4 ? 0.002 : 0.2);
          CHECK_NEAR(grad_params[i] - (4 + i), d.value, 1e-8 * (1 + std::abs(d.value)) + d.rounding);
        }
      });
    }
  }
}

TEST(vectors_of_pixels_are_pixels) {
  using T = VectorOf<float, 8>::type;
  std::mt19937_64 random(5);
  std::normal_distribution<float> normal;
  for (int repeat = 0; repeat < 1000; ++repeat) {
    float x[8], y[8];
    for (int lane = 0; lane < 8; ++lane) {
      x[lane] = repeat % 7 == lane ? 319.5f : 300 * normal(random), y[lane] = 300 * normal(random);
    }
    for_each_model<float>(views[0], [&](const auto& camera) {
      Ray<T> rays;
      Pixel<T> pixels;
      const Mask<T> seen = camera.unproject(Pixel<T>{load_lanes<T>(x), load_lanes<T>(y)}, rays);
      const Mask<T> live = camera.project(rays, pixels);
      for (int lane = 0; lane < 8; ++lane) {
        Ray<float> ray;
        CHECK(camera.unproject(Pixel<float>{x[lane], y[lane]}, ray) == (seen[lane] != 0));
        if (!seen[lane]) continue;
        CHECK_NEAR(rays.x[lane], ray.x, 1e-6);
        CHECK_NEAR(rays.y[lane], ray.y, 1e-6 * (1 + std::abs(ray.y)));
        CHECK_NEAR(rays.z[lane], ray.z, 1e-6 * (1 + std::abs(ray.z)));
        if (!live[lane]) continue;
        CHECK_NEAR(pixels.x[lane], x[lane], 1e-3);
        CHECK_NEAR(pixels.y[lane], y[lane], 1e-3);
      }
    });
  }
}
