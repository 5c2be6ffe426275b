// From a run of target pixels to the coordinates they read in the source image, and the adjoint.
#pragma once

#include "../geometry/kannala_brandt.h"
#include "../geometry/pinhole.h"
#include "resample.h"

// The width of vectors in bytes; each rows_*.cpp says its own.
#ifndef FISHEYEREC_VECTOR_BYTES
#define FISHEYEREC_VECTOR_BYTES 16
#endif

namespace fisheyerec {

// Pixels are handled in runs of one row, so that everything about a run stays in the first-level cache.
constexpr int run_length = 256;

template <class S>
struct Camera {
  CameraModel model;
  Pinhole<S> pinhole;
  KannalaBrandt<S> kannala_brandt;
};

// The cameras of one image of the batch, ready for the kernels.
template <class S>
struct Geometry {
  Camera<S> source, target;
  bool rotated;
  S source_from_target[9];
  bool finite;  // false: some parameter is NaN or infinite, and every pixel is invalid
};

struct GeometryGradient {
  double source[8], target[8], source_from_target[9];
};

inline namespace FISHEYEREC_ISA {

// What one step of a loop over pixels works on: a vector of floats, or one double.
template <class S>
struct PackOf {
  using type = typename VectorOf<S, FISHEYEREC_VECTOR_BYTES / sizeof(S)>::type;
};
template <>
struct PackOf<double> {
  using type = double;
};
template <class S>
using Pack = typename PackOf<S>::type;

// Calls visit with the concrete camera: the model is chosen once per run, outside the pixel loop.
template <class S, class Visit>
FISHEYEREC_INLINE void with_model(const Camera<S>& camera, const Visit& visit) {
  switch (camera.model) {
    case CameraModel::pinhole: return visit(camera.pinhole);
    case CameraModel::kannala_brandt: return visit(camera.kannala_brandt);
  }
}

// x, y: where target pixels (column + i, row) lie in the source image; NaN where the ray is invalid. Written in whole
// packs, beyond count too.
template <class S>
FISHEYEREC_NOINLINE void map_run(const Geometry<S>& geometry, int64_t row, int64_t column, int count, S* x, S* y) {
  using T = Pack<S>;
  const T nan = splat<T>(std::numeric_limits<S>::quiet_NaN());
  const auto map = [&](const auto& source, const auto& target, auto rotated) {
    for (int i = 0; i < count; i += lanes<T>) {
      Ray<T> ray;
      Pixel<T> pixel;
      const Pixel<T> at{count_from<T>(static_cast<S>(column + i)), splat<T>(row)};
      const Mask<T> seen = target.unproject(at, ray);
      if constexpr (rotated.value) ray = rotate(geometry.source_from_target, ray);
      const Mask<T> hit = source.project(ray, pixel);
      const Mask<T> live = seen & hit;
      store_lanes(x + i, select(live, pixel.x, nan));
      store_lanes(y + i, select(live, pixel.y, nan));
    }
  };
  if (!geometry.finite) {
    for (int i = 0; i < count; i += lanes<T>) store_lanes(x + i, nan), store_lanes(y + i, nan);
    return;
  }
  with_model(geometry.source, [&](const auto& source) {
    with_model(geometry.target, [&](const auto& target) {
      geometry.rotated ? map(source, target, std::true_type{}) : map(source, target, std::false_type{});
    });
  });
}

// grad_x, grad_y: gradients to what map_run gave, readable in whole packs and zero beyond count. Adds this run's
// gradients; beyond the source camera's only where `want_target`.
template <class S>
FISHEYEREC_NOINLINE void map_run_adjoint(const Geometry<S>& geometry, int64_t row, int64_t column, int count,
                                         const S* grad_x, const S* grad_y, bool want_target,
                                         GeometryGradient& gradient) {
  if (!geometry.finite) return;
  using T = Pack<S>;
  const auto adjoint = [&](const auto& source, const auto& target, auto wants_target) {
    constexpr int source_count = std::decay_t<decltype(source)>::parameter_count;
    constexpr int target_count = std::decay_t<decltype(target)>::parameter_count;
    const T zero = splat<T>(0);
    T source_sum[source_count] = {}, target_sum[target_count] = {}, rotation_sum[9] = {};
    for (int i = 0; i < count; i += lanes<T>) {
      const Pixel<T> at{count_from<T>(static_cast<S>(column + i)), splat<T>(row)};
      const Pixel<T> grad_pixel{load_lanes<T>(grad_x + i), load_lanes<T>(grad_y + i)};
      // Gradients are exactly zero where the ray is invalid, which is where the adjoint may meet 0/0.
      const Mask<T> live = (grad_pixel.x != zero) | (grad_pixel.y != zero);
      Ray<T> target_ray, grad_ray{zero, zero, zero}, grad_target_ray{zero, zero, zero};
      T grad_source[source_count] = {}, grad_target[target_count] = {}, grad_rotation[9] = {};
      target.unproject(at, target_ray);
      const Ray<T> ray = geometry.rotated ? rotate(geometry.source_from_target, target_ray) : target_ray;
      source.project_adjoint(ray, grad_pixel, grad_ray, grad_source);
      for (int j = 0; j < source_count; ++j) source_sum[j] += select(live, grad_source[j], zero);
      if constexpr (wants_target.value) {
        if (geometry.rotated) {
          rotate_adjoint(geometry.source_from_target, target_ray, grad_ray, grad_target_ray, grad_rotation);
          for (int j = 0; j < 9; ++j) rotation_sum[j] += select(live, grad_rotation[j], zero);
        } else {
          grad_target_ray = grad_ray;
        }
        target.unproject_adjoint(at, grad_target_ray, grad_target);
        for (int j = 0; j < target_count; ++j) target_sum[j] += select(live, grad_target[j], zero);
      }
    }
    const auto add = [](int parameters, const T* sums, double* total) {
      for (int j = 0; j < parameters; ++j) {
        S values[lanes<T>];
        store_lanes(values, sums[j]);
        for (const S value : values) total[j] += static_cast<double>(value);
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
