// The Kannala-Brandt fisheye (KB4, cv2.fisheye, Eq. 3 of FishEyeRecNet; Kannala and Brandt, ICPR 2004):
//
//   r = sqrt(X^2 + Y^2),  theta = atan2(r, Z),  theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
//   x = fx theta_d X/r + cx,  y = fy theta_d Y/r + cy
//
// The lens ends at theta_max, the first extremum of theta_d: beyond it the polynomial folds the picture back over
// itself, so rays there are invalid.
#pragma once

#include "trigonometry.h"

namespace fisheyerec {

template <class S>
struct KannalaBrandt {
  static constexpr int parameter_count = 8;
  static constexpr int knot_count = 64;  // cells of the table the Newton inverse starts from

  S fx, fy, cx, cy, k1, k2, k3, k4;
  S abs_k[4];               // |k1|..|k4|
  S theta_max;              // in [0, pi]
  S theta_d_max;            // theta_d(theta_max)
  S knots[knot_count + 1];  // theta at even steps of table_position()

  // invertible: also the table that unproject() needs, which takes longer than a small image.
  static KannalaBrandt make(const double* params, bool invertible = true);

  template <class T>
  FISHEYEREC_INLINE T theta_d(T theta) const {
    const T u = theta * theta;
    return theta * (S(1) + u * (k1 + u * (k2 + u * (k3 + u * k4))));
  }

  template <class T>
  FISHEYEREC_INLINE T theta_d_derivative(T theta) const {
    const T u = theta * theta;
    return S(1) + u * (3 * k1 + u * (5 * k2 + u * (7 * k3 + u * (9 * k4))));
  }

  template <class T>
  struct Inverse {
    T theta;
    Mask<T> converged;
  };

  // Where `distance` = theta_d lies in the table, in [0, knot_count]. Even steps of this position are short steps of
  // theta everywhere: the fraction keeps high polynomials, whose theta_d explodes towards pi, from crowding the
  // picture into the first cell, and theta is smooth in the square root even at a theta_max where the slope vanishes.
  template <class T>
  FISHEYEREC_INLINE static T table_position(T distance, S theta_d_max) {
    const T rest = (theta_d_max - distance) / ((S(1) + distance) * theta_d_max);  // 1 at distance 0, 0 at theta_d_max
    return (S(1) - square_root(rest)) * S(knot_count);
  }

  // theta with theta_d(theta) = distance, for distance in [0, theta_d_max]; converged is false elsewhere.
  // Newton from the table, bisecting where it would leave its bracket. A fixed count of steps, so that pixels can
  // share vector instructions.
  template <class T>
  FISHEYEREC_INLINE Inverse<T> theta_from_theta_d(T distance) const {
    constexpr int steps = sizeof(S) == 8 ? 8 : 3;
    const T zero = splat<T>(0), flat = splat<T>(sizeof(S) == 8 ? 0x1p-26 : 0x1p-12);  // about sqrt(epsilon)
    const Mask<T> in_range =
        (distance >= zero) & (distance <= splat<T>(theta_d_max)) & splat<Mask<T>>(theta_d_max > 0 ? -1 : 0);
    // A theta_d_max beyond the number type makes the position NaN, which is no index.
    T position = table_position(distance, theta_d_max);
    position = select(in_range & (position >= zero) & (position <= splat<T>(knot_count)), position, zero);
    const Index<T> whole = truncate(position), last = splat<Index<T>>(knot_count - 1);
    const Index<T> cell = select(whole < last, whole, last);
    T low, high;
    lookup_pair(knots, cell, low, high);
    T theta = low + (high - low) * (position - to_real<T>(cell));
    for (int step = 0; step < steps; ++step) {
      const T residual = theta_d(theta) - distance;
      low = select(residual < zero, theta, low);
      high = select(residual < zero, high, theta);
      // Right at the rim rounding makes the slope 0 or less; a step by a small slope stays near, bisection would not.
      const T slope = theta_d_derivative(theta);
      const T next = theta - residual / select(slope > flat, slope, flat);
      theta = select((next >= low) & (next <= high), next, (low + high) * S(0.5));
    }
    const T residual = theta_d(theta) - distance;
    // At the rim the slope is 0 and theta itself is only known to the square root of epsilon; what counts is where
    // the ray lands, as exactly as the sum that theta_d is can be rounded.
    const T u = theta * theta;
    const T terms = theta * (S(1) + u * (abs_k[0] + u * (abs_k[1] + u * (abs_k[2] + u * abs_k[3]))));
    const T tolerance = 16 * std::numeric_limits<S>::epsilon() * (S(1) + terms);
    const Mask<T> converged = in_range & (residual <= tolerance) & (-residual <= tolerance);
    return {theta, converged};
  }

  // The implicit function theorem at the solution, no unrolling:
  //   dtheta/ddistance = 1 / theta_d'(theta),  dtheta/dk_i = -theta^(2i+1) / theta_d'(theta)
  template <class T>
  FISHEYEREC_INLINE void theta_from_theta_d_adjoint(T theta, T grad_theta, T& grad_distance, T* grad_params) const {
    const T slope = theta_d_derivative(theta);
    const T g = select(slope > splat<T>(0), grad_theta / slope, splat<T>(0));
    const T u = theta * theta;
    T power = theta;
    for (int i = 0; i < 4; ++i) grad_params[4 + i] -= g * (power *= u);
    grad_distance += g;
  }

  template <class T>
  FISHEYEREC_INLINE Mask<T> project(const Ray<T>& ray, Pixel<T>& pixel) const {
    const T r = square_root(ray.x * ray.x + ray.y * ray.y);
    const T theta = atan2_upper(r, ray.z);
    const Mask<T> off_axis = r > splat<T>(0);  // on the axis theta_d / r -> 1/Z
    const T scale = select(off_axis, theta_d(theta), splat<T>(1)) / select(off_axis, r, ray.z);
    pixel.x = cx + fx * (ray.x * scale);
    pixel.y = cy + fy * (ray.y * scale);
    const T zero = splat<T>(0);
    return (theta <= splat<T>(theta_max)) & ((r > zero) | (ray.z > zero));
  }

  template <class T>
  FISHEYEREC_INLINE void project_adjoint(const Ray<T>& ray, const Pixel<T>& grad_pixel, Ray<T>& grad_ray,
                                         T* grad_params) const {
    const T r2 = ray.x * ray.x + ray.y * ray.y;
    const T r = square_root(r2);
    const T theta = atan2_upper(r, ray.z);
    const Mask<T> on_axis = r == splat<T>(0);
    const T inverse_r = select(on_axis, splat<T>(0), S(1) / r);
    const T scale = select(on_axis, S(1) / ray.z, theta_d(theta) * inverse_r);

    const T grad_x = grad_pixel.x * fx, grad_y = grad_pixel.y * fy;
    grad_params[0] += grad_pixel.x * (ray.x * scale);
    grad_params[1] += grad_pixel.y * (ray.y * scale);
    grad_params[2] += grad_pixel.x;
    grad_params[3] += grad_pixel.y;

    // dscale/dk_i = theta^(2i+1) / r, which is 0 on the axis.
    const T grad_scale = grad_x * ray.x + grad_y * ray.y;
    const T u = theta * theta;
    T power = theta * inverse_r;
    for (int i = 0; i < 4; ++i) grad_params[4 + i] += grad_scale * (power *= u);

    // scale(r, Z) = theta_d(theta) / r with dtheta/dr = Z / (r^2 + Z^2), dtheta/dZ = -r / (r^2 + Z^2)
    const T slope = theta_d_derivative(theta) / (r2 + ray.z * ray.z);
    const T grad_r_over_r = grad_scale * inverse_r * (slope * ray.z - scale) * inverse_r;
    grad_ray.x += grad_x * scale + grad_r_over_r * ray.x;
    grad_ray.y += grad_y * scale + grad_r_over_r * ray.y;
    grad_ray.z -= grad_scale * slope;
  }

  // The ray has unit length: (sin(theta) m / |m|, cos(theta)) with m = ((x - cx)/fx, (y - cy)/fy).
  template <class T>
  FISHEYEREC_INLINE Mask<T> unproject(const Pixel<T>& pixel, Ray<T>& ray) const {
    const T mx = (pixel.x - cx) / fx, my = (pixel.y - cy) / fy;
    const T distance = square_root(mx * mx + my * my);
    const Inverse<T> inverse = theta_from_theta_d(distance);
    T sin_theta, cos_theta;
    sin_cos(inverse.theta, sin_theta, cos_theta);
    const T scale = select(distance > splat<T>(0), sin_theta / distance, splat<T>(1));
    ray = {mx * scale, my * scale, cos_theta};
    return inverse.converged;
  }

  template <class T>
  FISHEYEREC_INLINE void unproject_adjoint(const Pixel<T>& pixel, const Ray<T>& grad_ray, T* grad_params) const {
    const T mx = (pixel.x - cx) / fx, my = (pixel.y - cy) / fy;
    const T distance = square_root(mx * mx + my * my);
    const T theta = theta_from_theta_d(distance).theta;
    T sin_theta, cos_theta;
    sin_cos(theta, sin_theta, cos_theta);
    const Mask<T> on_axis = distance == splat<T>(0);
    const T inverse_distance = select(on_axis, splat<T>(0), S(1) / distance);
    const T scale = select(on_axis, splat<T>(1), sin_theta * inverse_distance);

    // scale = sin(theta) / distance, theta = theta(distance, k)
    const T grad_scale_over_distance = (grad_ray.x * mx + grad_ray.y * my) * inverse_distance;
    const T grad_theta = grad_scale_over_distance * cos_theta - grad_ray.z * sin_theta;
    T grad_distance = -grad_scale_over_distance * scale;
    theta_from_theta_d_adjoint(theta, grad_theta, grad_distance, grad_params);

    const T grad_mx = grad_ray.x * scale + grad_distance * (mx * inverse_distance);
    const T grad_my = grad_ray.y * scale + grad_distance * (my * inverse_distance);
    grad_params[0] -= grad_mx * mx / fx;
    grad_params[1] -= grad_my * my / fy;
    grad_params[2] -= grad_mx / fx;
    grad_params[3] -= grad_my / fy;
  }
};

// The first extremum of theta_d in (0, pi], or pi where theta_d rises all the way.
//
// theta_d'(theta) is a quartic in u = theta^2. Its roots lie between the roots of its derivative, whose roots lie
// between those of the next: from the linear derivative upwards, each interval holds at most one root, which
// bisection finds whatever the coefficients.
inline double monotonic_limit(const double k[4]) {
  constexpr double u_max = pi<double> * pi<double>;
  double coefficients[5] = {1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]};
  for (double c : coefficients) {
    if (!std::isfinite(c)) return 0;
  }
  double edges[6] = {0, u_max};
  int edge_count = 2;
  for (int order = 3; order >= 0; --order) {  // the order-th derivative of the quartic, degree 4 - order
    double c[5];
    const int degree = 4 - order;
    for (int i = 0; i <= degree; ++i) {
      c[i] = coefficients[i + order];
      for (int j = 1; j <= order; ++j) c[i] *= i + j;
    }
    const auto value = [&](double u) {
      double sum = 0;
      for (int i = degree; i >= 0; --i) sum = sum * u + c[i];
      return sum;
    };
    double roots[6] = {0};
    int root_count = 1;
    for (int i = 0; i + 1 < edge_count; ++i) {
      double low = edges[i], high = edges[i + 1];
      const bool rising = value(low) < 0;
      if (rising == (value(high) < 0)) continue;
      for (int step = 0; step < 100 && low < high; ++step) {
        const double middle = low + (high - low) / 2;
        if (middle <= low || middle >= high) break;
        ((value(middle) < 0) == rising ? low : high) = middle;
      }
      roots[root_count++] = low;
    }
    roots[root_count] = u_max;
    edge_count = root_count + 1;
    for (int i = 0; i < edge_count; ++i) edges[i] = roots[i];
  }
  return edge_count > 2 ? std::sqrt(edges[1]) : pi<double>;
}

template <class S>
KannalaBrandt<S> KannalaBrandt<S>::make(const double* p, bool invertible) {
  KannalaBrandt<double> exact{p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], {}, 0, 0, {}};
  exact.theta_max = monotonic_limit(p + 4);
  exact.theta_d_max = exact.theta_d(exact.theta_max);

  KannalaBrandt<S> camera{};
  camera.fx = static_cast<S>(p[0]), camera.fy = static_cast<S>(p[1]);
  camera.cx = static_cast<S>(p[2]), camera.cy = static_cast<S>(p[3]);
  camera.k1 = static_cast<S>(p[4]), camera.k2 = static_cast<S>(p[5]);
  camera.k3 = static_cast<S>(p[6]), camera.k4 = static_cast<S>(p[7]);
  for (int i = 0; i < 4; ++i) camera.abs_k[i] = static_cast<S>(std::abs(p[4 + i]));
  camera.theta_max = static_cast<S>(exact.theta_max);
  camera.theta_d_max = static_cast<S>(exact.theta_d_max);
  if (!invertible) return camera;
  camera.knots[0] = 0;
  camera.knots[knot_count] = camera.theta_max;
  double low = 0;  // Newton kept inside a bracket by bisection; it starts where the last knot was found
  for (int i = 1; i < knot_count; ++i) {
    const double q = 1 - static_cast<double>(i) / knot_count;  // table_position(distance) = i, solved for distance
    const double distance = exact.theta_d_max * (1 - q * q) / (1 + q * q * exact.theta_d_max);
    double high = exact.theta_max, theta = low;
    for (int step = 0; step < 60; ++step) {
      const double residual = exact.theta_d(theta) - distance;
      (residual < 0 ? low : high) = theta;
      double next = theta - residual / exact.theta_d_derivative(theta);
      if (!(next > low && next < high)) next = low + (high - low) / 2;
      if (std::abs(next - theta) <= 1e-15) break;
      theta = next;
    }
    camera.knots[i] = static_cast<S>(theta);
  }
  return camera;
}

}  // namespace fisheyerec
