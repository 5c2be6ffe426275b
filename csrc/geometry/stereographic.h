// The stereographic view, which keeps every small shape:  |(u, v)| = 2 tan(theta / 2), with R = |(X, Y, Z)|
//
//   u = s X,  v = s Y,  s = 2 / (R + Z);   x = fx u + cx,  y = fy v + cy
#pragma once

#include "image_plane.h"

namespace fisheyerec {

template <class S>
struct Stereographic : ImagePlane<S> {
  static constexpr int parameter_count = 4;
  template <class T>
  using Point = typename ImagePlane<S>::template Point<T>;

  static Stereographic make(const double* params) { return {ImagePlane<S>::make(params)}; }

  // The ray straight behind is invalid.
  template <class T>
  FISHEYEREC_INLINE Mask<T> project(const Ray<T>& ray, Pixel<T>& pixel) const {
    T length;
    const T s = scale(ray, length);
    pixel = this->to_pixel(Point<T>{s * ray.x, s * ray.y});
    const T zero = splat<T>(0);
    return (ray.z > zero) | (ray.x * ray.x + ray.y * ray.y > zero);
  }

  template <class T>
  FISHEYEREC_INLINE void project_adjoint(const Ray<T>& ray, const Pixel<T>& grad_pixel, Ray<T>& grad_ray,
                                         T* grad_params) const {
    T length;
    const T s = scale(ray, length);
    const Point<T> grad = this->to_pixel_adjoint(Point<T>{s * ray.x, s * ray.y}, grad_pixel, grad_params);
    // ds = -(s^2 / 2) (dR + dZ)
    const T grad_length = (grad.u * ray.x + grad.v * ray.y) * s * s / S(-2);
    const T along = grad_length / length;
    grad_ray.x += grad.u * s + along * ray.x;
    grad_ray.y += grad.v * s + along * ray.y;
    grad_ray.z += grad_length + along * ray.z;
  }

  // The ray has R + Z = 2: it runs from the point behind, where the projection starts, moved to the origin.
  template <class T>
  FISHEYEREC_INLINE Mask<T> unproject(const Pixel<T>& pixel, Ray<T>& ray) const {
    const Point<T> point = this->from_pixel(pixel);
    const T quarter = (point.u * point.u + point.v * point.v) / S(4);
    ray = {point.u, point.v, S(1) - quarter};
    return quarter < splat<T>(std::numeric_limits<S>::infinity());
  }

  template <class T>
  FISHEYEREC_INLINE void unproject_adjoint(const Pixel<T>& pixel, const Ray<T>& grad_ray, T* grad_params) const {
    const Point<T> point = this->from_pixel(pixel);
    const T inwards = grad_ray.z / S(2);
    const Point<T> grad{grad_ray.x - inwards * point.u, grad_ray.y - inwards * point.v};
    this->from_pixel_adjoint(pixel, grad, grad_params);
  }

 private:
  template <class T>
  FISHEYEREC_INLINE static T scale(const Ray<T>& ray, T& length) {
    const T r2 = ray.x * ray.x + ray.y * ray.y;
    length = square_root(r2 + ray.z * ray.z);
    // Behind, R + Z = r^2 / (R - Z), which keeps its digits.
    const Mask<T> behind = ray.z < splat<T>(0);
    const T sum = length + select(behind, -ray.z, ray.z);
    return select(behind, sum + sum, splat<T>(2)) / select(behind, r2, sum);
  }
};

}  // namespace fisheyerec
