#define FISHEYEREC_ISA test_isa
#include "../kernels/piecewise.h"

#include <algorithm>

#include "../kernels/map.h"
#include "cameras.h"
#include "check.h"

using namespace fisheyerec;

namespace {

constexpr int length = Piecewise::length, node_count = Piecewise::node_count;

// Fills out from the nodes of a function of the pixel; false where it was refused.
template <class Function>
bool interpolate(const Function& function, float* out) {
  float values[node_count], coefficients[node_count];
  for (int j = 0; j < node_count; ++j) values[j] = static_cast<float>(function(Piecewise::nodes[j]));
  if (!fit_piece(values, coefficients)) return false;
  evaluate_piece(coefficients, out);
  return true;
}

}  // namespace

TEST(smooth_functions_are_met_between_the_nodes) {
  const auto line = [](int i) { return 1900.5 + 0.75 * i; };
  const auto wave = [](int i) { return 300 * std::sin(0.01 * i) + 20; };
  const auto bow = [](int i) { return 80 / (1 + 2e-5 * (i - 20) * (i - 20)); };
  float out[length];
  const auto check = [&](const auto& function, double tolerance) {
    CHECK(interpolate(function, out));
    for (int i = 0; i < length; ++i) CHECK_NEAR(out[i], function(i), tolerance);
  };
  check(line, 2e-4);  // float's step at 1900
  check(wave, 3e-5);
  check(bow, 7e-5);
}

TEST(what_is_not_smooth_is_refused) {
  float out[length];
  CHECK(!interpolate([](int i) { return std::abs(i - 30.0); }, out));
  CHECK(!interpolate([](int i) { return i == 24 ? 0.01 : 0.0; }, out));
  CHECK(!interpolate([](int i) { return 30 / (1 + 0.01 * (i - 31.5) * (i - 31.5)); }, out));  // even
  CHECK(!interpolate([](int i) { return std::atan(0.2 * (i - 31.5)) * 10; }, out));           // odd
  CHECK(!interpolate([](int i) { return i == 63 ? std::nan("") : 1.0; }, out));
  CHECK(!interpolate([](int i) { return i == 3 ? 1e39 : 1.0; }, out));  // infinite in float
}

// Every lens at sizes from a thumbnail to its own: short focal lengths bend too much and are computed pixel by pixel.
void check_map(CameraModel target_model, const double* rotation) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    for (const int width : {32, 256, camera.width}) {
      const double scale = static_cast<double>(width) / camera.width;
      const int height = std::max(1, static_cast<int>(camera.height * scale));
      double params[8];
      std::copy(camera.params, camera.params + 8, params);
      for (int i = 0; i < 2; ++i) params[i] *= scale;
      for (int i = 2; i < 4; ++i) params[i] = (params[i] + 0.5) * scale - 0.5;
      const double view[5] = {width / 2.5, width / 2.5, (width - 1) / 2.0, (height - 1) / 2.0, 0.8};
      const auto geometry = [&](auto zero) {
        using S = decltype(zero);
        Geometry<S> g{};
        g.source.model = CameraModel::kannala_brandt;
        g.source.kannala_brandt = KannalaBrandt<S>::make(params, false);
        g.target.model = target_model;
        g.target.pinhole = Pinhole<S>::make(view);
        g.target.cylindrical = Cylindrical<S>::make(view);
        g.target.equirectangular = Equirectangular<S>::make(view);
        g.target.stereographic = Stereographic<S>::make(view);
        g.target.panini = Panini<S>::make(view);
        g.rotated = rotation != nullptr;
        for (int i = 0; i < 9 && rotation; ++i) g.source_from_target[i] = static_cast<S>(rotation[i]);
        g.finite = true;
        return g;
      };
      const Geometry<float> narrow = geometry(0.0f);
      const Geometry<double> wide = geometry(0.0);
      for (int row = 0; row < height; row += std::max(1, height / 9)) {
        for (int column = 0; column < width; column += run_length) {
          const int count = std::min(run_length, width - column);
          alignas(64) float x[run_length], y[run_length];
          alignas(64) double exact_x[run_length], exact_y[run_length];
          map_run(narrow, row, column, count, x, y);
          map_run(wide, row, column, count, exact_x, exact_y);
          for (int i = 0; i < count; ++i) {
            const bool inside_both = inside(exact_x[i], static_cast<double>(width)) &&
                                     inside(exact_y[i], static_cast<double>(height)) && !std::isnan(x[i]);
            if (!inside_both) continue;  // at the lens' rim float may fall on the other side
            CHECK_NEAR(x[i], exact_x[i], 1e-4 + 4e-7 * width);
            CHECK_NEAR(y[i], exact_y[i], 1e-4 + 4e-7 * width);
          }
        }
      }
    }
  }
}

TEST(the_map_in_float_is_the_map_in_double) {
  const double turned[9] = {0.98006658,  0,           0.19866933, 0.01986693, 0.99498744,
                            -0.09800666, -0.19767681, 0.09999983, 0.97515388};
  for (const CameraModel target : {CameraModel::pinhole, CameraModel::cylindrical, CameraModel::equirectangular,
                                   CameraModel::stereographic, CameraModel::panini}) {
    check_map(target, nullptr);
    check_map(target, turned);
  }
}
