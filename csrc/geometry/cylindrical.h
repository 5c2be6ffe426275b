// The cylindrical view: the longitude lambda = atan2(X, Z) to the right, perspective upright.
//
//   u = lambda,  v = Y / h,  h = sqrt(X^2 + Z^2);   x = fx u + cx,  y = fy v + cy
#pragma once

#include "image_plane.h"

namespace fisheyerec {

template <class S>
struct Cylindrical : ImagePlane<S> {
  static constexpr int parameter_count = 4;
  template <class T>
  using Point = typename ImagePlane<S>::template Point<T>;

  static Cylindrical make(const double* params) { return {ImagePlane<S>::make(params)}; }

  // Rays along the cylinder's axis are invalid.
  template <class T>
  FISHEYEREC_INLINE Mask<T> project(const Ray<T>& ray, Pixel<T>& pixel) const {
    const T h = square_root(ray.x * ray.x + ray.z * ray.z);
    pixel = this->to_pixel(Point<T>{atan2_signed(ray.x, ray.z), ray.y / h});
    return h > splat<T>(0);
  }

  template <class T>
  FISHEYEREC_INLINE void project_adjoint(const Ray<T>& ray, const Pixel<T>& grad_pixel, Ray<T>& grad_ray,
                                         T* grad_params) const {
    const T inverse_h = S(1) / square_root(ray.x * ray.x + ray.z * ray.z);
    const T v = ray.y * inverse_h, sin_lambda = ray.x * inverse_h, cos_lambda = ray.z * inverse_h;
    const Point<T> grad = this->to_pixel_adjoint(Point<T>{atan2_signed(ray.x, ray.z), v}, grad_pixel, grad_params);
    grad_ray.x += (grad.u * cos_lambda - grad.v * (v * sin_lambda)) * inverse_h;
    grad_ray.y += grad.v * inverse_h;
    grad_ray.z -= (grad.u * sin_lambda + grad.v * (v * cos_lambda)) * inverse_h;
  }

  // The ray lies on the cylinder, X^2 + Z^2 = 1. Once around is all there is.
  template <class T>
  FISHEYEREC_INLINE Mask<T> unproject(const Pixel<T>& pixel, Ray<T>& ray) const {
    const Point<T> point = this->from_pixel(pixel);
    T sin_lambda, cos_lambda;
    sin_cos_signed(point.u, sin_lambda, cos_lambda);
    ray = {sin_lambda, point.v, cos_lambda};
    return (point.u >= splat<T>(-pi<S>)) & (point.u <= splat<T>(pi<S>));
  }

  template <class T>
  FISHEYEREC_INLINE void unproject_adjoint(const Pixel<T>& pixel, const Ray<T>& grad_ray, T* grad_params) const {
    T sin_lambda, cos_lambda;
    sin_cos_signed(this->from_pixel(pixel).u, sin_lambda, cos_lambda);
    const Point<T> grad{grad_ray.x * cos_lambda - grad_ray.z * sin_lambda, grad_ray.y};
    this->from_pixel_adjoint(pixel, grad, grad_params);
  }
};

}  // namespace fisheyerec
