// From a run of target pixels to the coordinates they read in the source image, and the adjoint.
#pragma once

#include "../geometry/cylindrical.h"
#include "../geometry/equirectangular.h"
#include "../geometry/kannala_brandt.h"
#include "../geometry/panini.h"
#include "../geometry/pinhole.h"
#include "../geometry/stereographic.h"
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
  Cylindrical<S> cylindrical;
  Equirectangular<S> equirectangular;
  Stereographic<S> stereographic;
  Panini<S> panini;
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
    case CameraModel::cylindrical: return visit(camera.cylindrical);
    case CameraModel::equirectangular: return visit(camera.equirectangular);
    case CameraModel::stereographic: return visit(camera.stereographic);
    case CameraModel::panini: return visit(camera.panini);
  }
}

// The rays of a run, side by side as the kernels read them. Written in whole packs.
template <class S>
struct RunRays {
  alignas(64) S x[run_length], y[run_length], z[run_length];

  template <class T>
  FISHEYEREC_INLINE Ray<T> load(int i) const {
    return {load_lanes<T>(x + i), load_lanes<T>(y + i), load_lanes<T>(z + i)};
  }
  template <class T>
  FISHEYEREC_INLINE void store(int i, const Ray<T>& ray) {
    store_lanes(x + i, ray.x), store_lanes(y + i, ray.y), store_lanes(z + i, ray.z);
  }
};

// The rays, in the source camera's frame, of target pixels (columns(i), row); NaN where the target has none.
template <class S, class Columns>
FISHEYEREC_INLINE void unproject_run(const Geometry<S>& geometry, int64_t row, int count, const Columns& columns,
                                     RunRays<S>& rays) {
  using T = Pack<S>;
  with_model(geometry.target, [&](const auto& target) {
    const T nan = splat<T>(std::numeric_limits<S>::quiet_NaN());
    for (int i = 0; i < count; i += lanes<T>) {
      Ray<T> ray;
      const Mask<T> seen = target.unproject(Pixel<T>{columns(i), splat<T>(row)}, ray);
      if (geometry.rotated) ray = rotate(geometry.source_from_target, ray);
      ray.z = select(seen, ray.z, nan);
      rays.store(i, ray);
    }
  });
}

// Where the rays meet the source image; NaN where they do not.
template <class S>
FISHEYEREC_INLINE void project_run(const Geometry<S>& geometry, int count, const RunRays<S>& rays, S* x, S* y) {
  using T = Pack<S>;
  with_model(geometry.source, [&](const auto& source) {
    const T nan = splat<T>(std::numeric_limits<S>::quiet_NaN());
    for (int i = 0; i < count; i += lanes<T>) {
      Pixel<T> pixel;
      const Mask<T> live = source.project(rays.template load<T>(i), pixel);
      store_lanes(x + i, select(live, pixel.x, nan));
      store_lanes(y + i, select(live, pixel.y, nan));
    }
  });
}

// Whether a row can leave the lens and come back between two nodes of a piece that both see it. Rays of a row of a
// pinhole lie in a plane: they meet a cone of theta_max up to 90 degrees once, and an unrotated pinhole sees no ray
// beyond 90 degrees. In every unrotated view theta grows to both sides of the middle column. Towards the rim of a view
// as the source coordinates may run to infinity, which is not smooth.
template <class S>
FISHEYEREC_INLINE bool is_piecewise(const Geometry<S>& geometry) {
  const CameraModel source = geometry.source.model, target = geometry.target.model;
  if (source != CameraModel::kannala_brandt) {
    return source == CameraModel::pinhole && target == CameraModel::kannala_brandt;
  }
  const S theta_max = geometry.source.kannala_brandt.theta_max;
  const bool narrow = target == CameraModel::pinhole && theta_max <= pi<S> / 2;
  return target != CameraModel::kannala_brandt && (!geometry.rotated || narrow || theta_max >= pi<S>);
}

// x, y: where target pixels (column + i, row) lie in the source image; NaN where the ray is invalid. Written in whole
// packs, beyond count too.
template <class S>
FISHEYEREC_NOINLINE void map_run(const Geometry<S>& geometry, int64_t row, int64_t column, int count, S* x, S* y) {
  using T = Pack<S>;
  if (!geometry.finite) {
    const T nan = splat<T>(std::numeric_limits<S>::quiet_NaN());
    for (int i = 0; i < count; i += lanes<T>) store_lanes(x + i, nan), store_lanes(y + i, nan);
    return;
  }
  RunRays<S> rays;
  if constexpr (sizeof(S) == 4) {
    if (is_piecewise(geometry)) {
      constexpr int node_count = run_length / Piecewise::length * Piecewise::node_count;
      alignas(64) S node_x[node_count], node_y[node_count];
      const int pieces = (count + Piecewise::length - 1) / Piecewise::length;
      const int nodes = pieces * Piecewise::node_count;
      const T first = splat<T>(column);
      unproject_run(geometry, row, nodes, [&](int i) { return first + load_lanes<T>(piece_nodes.offset + i); }, rays);
      project_run(geometry, nodes, rays, node_x, node_y);
      // First all coefficients, then all pixels: each is a chain of operations that waits for nothing but itself.
      alignas(64) S coefficients_x[node_count], coefficients_y[node_count];
      bool smooth = true;
      for (int i = 0; i < nodes; i += Piecewise::node_count) {
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
  unproject_run(geometry, row, count, [&](int i) { return count_from<T>(static_cast<S>(column + i)); }, rays);
  project_run(geometry, count, rays, x, y);
}

// Adds up in packs, and at the end into doubles. Gradients are exactly zero where the ray is invalid, which is where
// an adjoint may meet 0/0: such lanes are left out.
template <class T, int count>
struct GradientSum {
  T sums[count] = {};

  FISHEYEREC_INLINE void add(const T* gradients, Mask<T> live) {
    for (int j = 0; j < count; ++j) sums[j] += select(live, gradients[j], splat<T>(0));
  }
  FISHEYEREC_INLINE void add_to(double* total) const {
    for (int j = 0; j < count; ++j) {
      Scalar<T> values[lanes<T>];
      store_lanes(values, sums[j]);
      for (const Scalar<T> value : values) total[j] += static_cast<double>(value);
    }
  }
};

// grad_x, grad_y: gradients to what map_run gave, readable in whole packs and zero beyond count. Adds this run's
// gradients; beyond the source camera's only where `want_target`.
template <class S>
FISHEYEREC_NOINLINE void map_run_adjoint(const Geometry<S>& geometry, int64_t row, int64_t column, int count,
                                         const S* grad_x, const S* grad_y, bool want_target,
                                         GeometryGradient& gradient) {
  if (!geometry.finite) return;
  using T = Pack<S>;
  const T zero = splat<T>(0);
  const auto columns = [&](int i) { return count_from<T>(static_cast<S>(column + i)); };
  const auto grad_pixel = [&](int i) { return Pixel<T>{load_lanes<T>(grad_x + i), load_lanes<T>(grad_y + i)}; };
  const auto is_live = [&](const Pixel<T>& grad) { return (grad.x != zero) | (grad.y != zero); };
  RunRays<S> rays, grad_rays;
  unproject_run(geometry, row, count, columns, rays);
  const auto adjoint_of_source = [&](const auto& source, auto keeps_rays) {
    constexpr int parameters = std::decay_t<decltype(source)>::parameter_count;
    GradientSum<T, parameters> sum;
    for (int i = 0; i < count; i += lanes<T>) {
      const Pixel<T> grad = grad_pixel(i);
      Ray<T> grad_ray{zero, zero, zero};
      T grad_params[parameters] = {};
      source.project_adjoint(rays.template load<T>(i), grad, grad_ray, grad_params);
      sum.add(grad_params, is_live(grad));
      if constexpr (keeps_rays.value) grad_rays.store(i, grad_ray);  // or the compiler leaves out what it takes
    }
    sum.add_to(gradient.source);
  };
  with_model(geometry.source, [&](const auto& source) {
    want_target ? adjoint_of_source(source, std::true_type{}) : adjoint_of_source(source, std::false_type{});
  });
  if (!want_target) return;
  with_model(geometry.target, [&](const auto& target) {
    constexpr int parameters = std::decay_t<decltype(target)>::parameter_count;
    GradientSum<T, parameters> sum;
    GradientSum<T, 9> rotation_sum;
    for (int i = 0; i < count; i += lanes<T>) {
      const Pixel<T> at{columns(i), splat<T>(row)};
      const Mask<T> live = is_live(grad_pixel(i));
      Ray<T> grad_ray = grad_rays.template load<T>(i);
      T grad_params[parameters] = {}, grad_rotation[9] = {};
      if (geometry.rotated) {
        Ray<T> ray, grad_rotated = grad_ray;
        target.unproject(at, ray);
        grad_ray = {zero, zero, zero};
        rotate_adjoint(geometry.source_from_target, ray, grad_rotated, grad_ray, grad_rotation);
        rotation_sum.add(grad_rotation, live);
      }
      target.unproject_adjoint(at, grad_ray, grad_params);
      sum.add(grad_params, live);
    }
    sum.add_to(gradient.target);
    rotation_sum.add_to(gradient.source_from_target);
  });
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
