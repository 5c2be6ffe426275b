// The Panini view of wide scenes: verticals stay straight, and so do lines to the middle (Sharpless, Postle, German:
// Pannini, Computational Aesthetics 2010). The world on a cylinder, h = sqrt(X^2 + Z^2), seen from d behind its axis:
//
//   u = s X,  v = s Y,  s = (d + 1) / (d h + Z);   x = fx u + cx,  y = fy v + cy
//
// d = 0 is the perspective view, d = 1 the cylindrical stereographic.
#pragma once

#include "image_plane.h"

namespace fisheyerec {

template <class S>
struct Panini : ImagePlane<S> {
  static constexpr int parameter_count = 5;  // fx, fy, cx, cy, d
  template <class T>
  using Point = typename ImagePlane<S>::template Point<T>;

  S d;

  static Panini make(const double* params) { return {ImagePlane<S>::make(params), static_cast<S>(params[4])}; }

  // Valid where d + cos(lambda) > 0 and, for d beyond 1, before u turns back, 1 + d cos(lambda) > 0.
  template <class T>
  FISHEYEREC_INLINE Mask<T> project(const Ray<T>& ray, Pixel<T>& pixel) const {
    const T h = square_root(ray.x * ray.x + ray.z * ray.z), zero = splat<T>(0);
    const T depth = d * h + ray.z;
    const T s = (d + S(1)) / depth;
    pixel = this->to_pixel(Point<T>{s * ray.x, s * ray.y});
    return (depth > zero) & (h + d * ray.z > zero) & has_distance<T>();
  }

  template <class T>
  FISHEYEREC_INLINE void project_adjoint(const Ray<T>& ray, const Pixel<T>& grad_pixel, Ray<T>& grad_ray,
                                         T* grad_params) const {
    const T h = square_root(ray.x * ray.x + ray.z * ray.z);
    const T inverse_depth = S(1) / (d * h + ray.z), s = (d + S(1)) * inverse_depth;
    const Point<T> grad = this->to_pixel_adjoint(Point<T>{s * ray.x, s * ray.y}, grad_pixel, grad_params);
    const T grad_s = grad.u * ray.x + grad.v * ray.y;
    const T grad_depth = -grad_s * s * inverse_depth, along = grad_depth * d / h;
    grad_params[4] += grad_s * inverse_depth + grad_depth * h;
    grad_ray.x += grad.u * s + along * ray.x;
    grad_ray.y += grad.v * s;
    grad_ray.z += grad_depth + along * ray.z;
  }

  // The ray lies on the cylinder, X^2 + Z^2 = 1: with k = (u / (d + 1))^2 and Q = sqrt(1 + k (1 - d^2)),
  //   Z = cos(lambda) = (Q - k d) / (1 + k),  X = q u,  Y = q v,  q = 1/s = (d + Z) / (d + 1).
  template <class T>
  FISHEYEREC_INLINE Mask<T> unproject(const Pixel<T>& pixel, Ray<T>& ray) const {
    const Point<T> point = this->from_pixel(pixel);
    const T k = squared(point.u / (d + S(1))), square = S(1) + k * (S(1) - d * d);
    const T z = (square_root(square) - k * d) / (S(1) + k), q = (d + z) / (d + S(1));
    ray = {q * point.u, q * point.v, z};
    return (square >= splat<T>(0)) & has_distance<T>();
  }

  template <class T>
  FISHEYEREC_INLINE void unproject_adjoint(const Pixel<T>& pixel, const Ray<T>& grad_ray, T* grad_params) const {
    const Point<T> point = this->from_pixel(pixel);
    const S inverse = S(1) / (d + S(1)), slope = S(1) - d * d;
    const T k = squared(point.u * inverse), Q = square_root(S(1) + k * slope), inverse_1_k = S(1) / (S(1) + k);
    const T z = (Q - k * d) * inverse_1_k, q = (d + z) * inverse;
    const T grad_q = grad_ray.x * point.u + grad_ray.y * point.v, grad_z = grad_ray.z + grad_q * inverse;
    // dZ/dk = (dQ/dk - d - Z) / (1 + k),  dZ/dd = -(k d / Q + k) / (1 + k),  dk/du = 2 k / u,  dk/dd = -2 k / (d + 1)
    const T grad_k = grad_z * (slope / (Q + Q) - d - z) * inverse_1_k;
    const Point<T> grad{grad_ray.x * q + grad_k * (point.u + point.u) * inverse * inverse, grad_ray.y * q};
    this->from_pixel_adjoint(pixel, grad, grad_params);
    grad_params[4] += grad_q * (S(1) - z) * inverse * inverse - grad_z * (k * (d / Q + S(1))) * inverse_1_k -
                      (grad_k + grad_k) * k * inverse;
  }

 private:
  template <class T>
  FISHEYEREC_INLINE Mask<T> has_distance() const {
    return splat<T>(d) >= splat<T>(0);
  }
  template <class T>
  FISHEYEREC_INLINE static T squared(T value) {
    return value * value;
  }
};

}  // namespace fisheyerec
