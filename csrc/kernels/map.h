// From a run of target pixels to the coordinates they read in the source image, and the adjoint.
#pragma once

#include "../geometry/kannala_brandt.h"
#include "../geometry/pinhole.h"
#include "resample.h"

namespace fisheyerec {

// Pixels are handled in runs of one row that fit the first-level cache; lanes is the width that every instruction
// set divides, so that sums are taken in the same order everywhere.
constexpr int run_length = 256;
constexpr int lanes = 16;

template <class T>
struct Camera {
  CameraModel model;
  Pinhole<T> pinhole;
  KannalaBrandt<T> kannala_brandt;
};

// The cameras of one image of the batch, ready for the kernels.
template <class T>
struct Geometry {
  Camera<T> source, target;
  bool rotated;
  T source_from_target[9];
  bool finite;  // false: some parameter is NaN or infinite, and every pixel is invalid
};

struct GeometryGradient {
  double source[8], target[8], source_from_target[9];
};

inline namespace FISHEYEREC_ISA {

// Calls visit with the concrete camera: the model is chosen once per run, outside the pixel loop.
template <class T, class Visit>
FISHEYEREC_INLINE void with_model(const Camera<T>& camera, const Visit& visit) {
  switch (camera.model) {
    case CameraModel::pinhole: return visit(camera.pinhole);
    case CameraModel::kannala_brandt: return visit(camera.kannala_brandt);
  }
}

// x, y: where target pixels (column + i, row) lie in the source image; NaN where the ray is invalid.
template <class T>
void map_run(const Geometry<T>& geometry, int64_t row, int64_t column, int count, T* x, T* y) {
  constexpr T nan = std::numeric_limits<T>::quiet_NaN();
  if (!geometry.finite) {
    for (int i = 0; i < count; ++i) x[i] = y[i] = nan;
    return;
  }
  const auto map = [&](const auto& source, const auto& target, auto rotated) {
#pragma omp simd
    for (int i = 0; i < count; ++i) {
      Ray<T> ray;
      Pixel<T> pixel;
      const bool seen = target.unproject({static_cast<T>(column + i), static_cast<T>(row)}, ray);
      if constexpr (rotated.value) ray = rotate(geometry.source_from_target, ray);
      const bool hit = source.project(ray, pixel);
      x[i] = seen && hit ? pixel.x : nan;
      y[i] = seen && hit ? pixel.y : nan;
    }
  };
  with_model(geometry.source, [&](const auto& source) {
    with_model(geometry.target, [&](const auto& target) {
      geometry.rotated ? map(source, target, std::true_type{}) : map(source, target, std::false_type{});
    });
  });
}

// grad_x, grad_y: gradients to what map_run gave; arrays are readable up to the next multiple of `lanes` and zero
// beyond count. Adds this run's gradients; beyond the source camera's only where `want_target`.
template <class T>
void map_run_adjoint(const Geometry<T>& geometry, int64_t row, int64_t column, int count, const T* grad_x,
                     const T* grad_y, bool want_target, GeometryGradient& gradient) {
  if (!geometry.finite) return;
  const auto adjoint = [&](const auto& source, const auto& target, auto wants_target) {
    constexpr int source_count = std::decay_t<decltype(source)>::parameter_count;
    constexpr int target_count = std::decay_t<decltype(target)>::parameter_count;
    T source_sum[source_count][lanes] = {}, target_sum[target_count][lanes] = {}, rotation_sum[9][lanes] = {};
    for (int begin = 0; begin < count; begin += lanes) {
#pragma omp simd
      for (int lane = 0; lane < lanes; ++lane) {
        const int i = begin + lane;
        const Pixel<T> target_pixel{static_cast<T>(column + i), static_cast<T>(row)};
        const Pixel<T> grad_pixel{grad_x[i], grad_y[i]};
        // Gradients are exactly zero where the ray is invalid, which is where the adjoint may meet 0/0.
        const bool live = !(grad_pixel.x == 0 && grad_pixel.y == 0);
        Ray<T> target_ray, ray, grad_ray{0, 0, 0}, grad_target_ray{0, 0, 0};
        T grad_source[source_count] = {}, grad_target[target_count] = {}, grad_rotation[9] = {};
        target.unproject(target_pixel, target_ray);
        ray = geometry.rotated ? rotate(geometry.source_from_target, target_ray) : target_ray;
        source.project_adjoint(ray, grad_pixel, grad_ray, grad_source);
        for (int j = 0; j < source_count; ++j) source_sum[j][lane] += live ? grad_source[j] : T(0);
        if constexpr (wants_target.value) {
          if (geometry.rotated) {
            rotate_adjoint(geometry.source_from_target, target_ray, grad_ray, grad_target_ray, grad_rotation);
          } else {
            grad_target_ray = grad_ray;
          }
          target.unproject_adjoint(target_pixel, grad_target_ray, grad_target);
          for (int j = 0; j < target_count; ++j) target_sum[j][lane] += live ? grad_target[j] : T(0);
          for (int j = 0; j < 9; ++j) rotation_sum[j][lane] += live ? grad_rotation[j] : T(0);
        }
      }
    }
    const auto add = [](int parameters, const T(*sums)[lanes], double* total) {
      for (int j = 0; j < parameters; ++j) {
        for (int lane = 0; lane < lanes; ++lane) total[j] += static_cast<double>(sums[j][lane]);
      }
    };
    add(source_count, source_sum, gradient.source);
    add(target_count, target_sum, gradient.target);
    add(9, rotation_sum, gradient.source_from_target);
  };
  with_model(geometry.source, [&](const auto& source) {
    with_model(geometry.target, [&](const auto& target) {
      want_target ? adjoint(source, target, std::true_type{}) : adjoint(source, target, std::false_type{});
    });
  });
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
