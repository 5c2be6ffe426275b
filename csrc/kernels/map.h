// From a run of target pixels to the coordinates they read in the source image, and the adjoint.
#pragma once

#include "../geometry/kannala_brandt.h"
#include "../geometry/pinhole.h"
#include "piecewise.h"
#include "resample.h"

namespace fisheyerec {

// Pixels are handled in runs of one row, so that everything about a run stays in the first-level cache.
constexpr int run_length = 256;

// The columns of a run at which the map is computed where it is smooth.
struct PieceNodes {
  float offset[run_length / Piecewise::length * Piecewise::node_count];

  static constexpr PieceNodes make() {
    PieceNodes nodes{};
    int i = 0;
    for (float& offset : nodes.offset) {
      offset = static_cast<float>(i / Piecewise::node_count * Piecewise::length +
                                  Piecewise::nodes[i % Piecewise::node_count]);
      ++i;
    }
    return nodes;
  }
};
constexpr PieceNodes piece_nodes = PieceNodes::make();

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

// Where one target pixel lies in the source image.
template <class S, class Source, class Target, class T>
FISHEYEREC_INLINE Mask<T> map_pixel(const Geometry<S>& geometry, const Source& source, const Target& target,
                                    bool rotated, const Pixel<T>& at, Pixel<T>& pixel) {
  Ray<T> ray;
  const Mask<T> seen = target.unproject(at, ray);
  if (rotated) ray = rotate(geometry.source_from_target, ray);
  return seen & source.project(ray, pixel);
}

// Whether a row can leave the lens and come back between two nodes of a piece that both see it. Rays of a row of a
// pinhole lie in a plane: they meet a cone of theta_max up to 90 degrees once, and an unrotated pinhole sees no ray
// beyond 90 degrees. Towards the rim of a pinhole source coordinates run to infinity, which is not smooth.
template <class S, class Source, class Target>
FISHEYEREC_INLINE bool is_piecewise(const Source& source, const Target&, bool rotated) {
  if constexpr (std::is_same_v<Source, KannalaBrandt<float>> && std::is_same_v<Target, Pinhole<float>>) {
    return !rotated || source.theta_max <= pi<float> / 2 || source.theta_max >= pi<float>;
  } else {
    return std::is_same_v<Source, Pinhole<float>> && std::is_same_v<Target, KannalaBrandt<float>>;
  }
}

// x, y: where target pixels (column + i, row) lie in the source image; NaN where the ray is invalid. Written in whole
// packs, beyond count too.
template <class S>
FISHEYEREC_NOINLINE void map_run(const Geometry<S>& geometry, int64_t row, int64_t column, int count, S* x, S* y) {
  using T = Pack<S>;
  const T nan = splat<T>(std::numeric_limits<S>::quiet_NaN());
  const auto map = [&](const auto& source, const auto& target, auto rotated) {
    const auto map_pack = [&](T columns, S* to_x, S* to_y) {
      Pixel<T> pixel;
      const Mask<T> live = map_pixel(geometry, source, target, rotated.value, Pixel<T>{columns, splat<T>(row)}, pixel);
      store_lanes(to_x, select(live, pixel.x, nan));
      store_lanes(to_y, select(live, pixel.y, nan));
    };
    if constexpr (sizeof(S) == 4) {
      if (is_piecewise<S>(source, target, rotated.value)) {
        constexpr int node_count = run_length / Piecewise::length * Piecewise::node_count;
        alignas(64) S node_x[node_count], node_y[node_count];
        const int pieces = (count + Piecewise::length - 1) / Piecewise::length;
        const T first = splat<T>(column);
        for (int i = 0; i < pieces * Piecewise::node_count; i += lanes<T>) {
          map_pack(first + load_lanes<T>(piece_nodes.offset + i), node_x + i, node_y + i);
        }
        // First all coefficients, then all pixels: each is a chain of operations that waits for nothing but itself.
        alignas(64) S coefficients_x[node_count], coefficients_y[node_count];
        bool smooth = true;
        for (int i = 0; i < pieces * Piecewise::node_count; i += Piecewise::node_count) {
          smooth &= fit_piece(node_x + i, coefficients_x + i);
          smooth &= fit_piece(node_y + i, coefficients_y + i);
        }
        for (int piece = 0; smooth && piece < pieces; ++piece) {
          const int node = piece * Piecewise::node_count, begin = piece * Piecewise::length;
          evaluate_piece(coefficients_x + node, x + begin);
          evaluate_piece(coefficients_y + node, y + begin);
        }
        if (smooth) return;
      }
    }
    for (int i = 0; i < count; i += lanes<T>) map_pack(count_from<T>(static_cast<S>(column + i)), x + i, y + i);
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
