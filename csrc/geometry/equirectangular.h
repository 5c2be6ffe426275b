// The equirectangular view: longitude and latitude are the axes.
//
//   u = lambda = atan2(X, Z),  v = phi = atan2(Y, h),  h = sqrt(X^2 + Z^2);   x = fx u + cx,  y = fy v + cy
#pragma once

#include "image_plane.h"

namespace fisheyerec {

template <class S>
struct Equirectangular : ImagePlane<S> {
  static constexpr int parameter_count = 4;
  template <class T>
  using Point = typename ImagePlane<S>::template Point<T>;

  static Equirectangular make(const double* params) { return {ImagePlane<S>::make(params)}; }

  // At the poles, where all longitudes meet, lambda is 0.
  template <class T>
  FISHEYEREC_INLINE Mask<T> project(const Ray<T>& ray, Pixel<T>& pixel) const {
    const T h = square_root(ray.x * ray.x + ray.z * ray.z), zero = splat<T>(0);
    pixel = this->to_pixel(longitude_and_latitude(ray, h));
    return (h > zero) | (ray.y > zero) | (ray.y < zero);
  }

  template <class T>
  FISHEYEREC_INLINE void project_adjoint(const Ray<T>& ray, const Pixel<T>& grad_pixel, Ray<T>& grad_ray,
                                         T* grad_params) const {
    const T h2 = ray.x * ray.x + ray.z * ray.z, h = square_root(h2), zero = splat<T>(0);
    const Point<T> grad = this->to_pixel_adjoint(longitude_and_latitude(ray, h), grad_pixel, grad_params);
    // dlambda/dX = Z/h^2, dlambda/dZ = -X/h^2, dphi/dY = h/R^2, dphi/dh = -Y/R^2; at a pole lambda has no slope.
    const T inverse_h = select(h > zero, S(1) / h, zero);
    const T sin_lambda = ray.x * inverse_h, cos_lambda = ray.z * inverse_h;
    const T grad_lambda = grad.u * inverse_h, grad_phi = grad.v / (h2 + ray.y * ray.y);
    grad_ray.x += grad_lambda * cos_lambda - grad_phi * ray.y * sin_lambda;
    grad_ray.y += grad_phi * h;
    grad_ray.z -= grad_lambda * sin_lambda + grad_phi * ray.y * cos_lambda;
  }

  // The ray has unit length. Once around and from pole to pole is all there is.
  template <class T>
  FISHEYEREC_INLINE Mask<T> unproject(const Pixel<T>& pixel, Ray<T>& ray) const {
    const Point<T> point = this->from_pixel(pixel);
    T sin_lambda, cos_lambda, sin_phi, cos_phi;
    sin_cos_signed(point.u, sin_lambda, cos_lambda);
    sin_cos_signed(point.v, sin_phi, cos_phi);
    ray = {cos_phi * sin_lambda, sin_phi, cos_phi * cos_lambda};
    const T half_turn = splat<T>(pi<S>), pole = splat<T>(pi<S> / 2);
    return (point.u >= -half_turn) & (point.u <= half_turn) & (point.v >= -pole) & (point.v <= pole);
  }

  template <class T>
  FISHEYEREC_INLINE void unproject_adjoint(const Pixel<T>& pixel, const Ray<T>& grad_ray, T* grad_params) const {
    const Point<T> point = this->from_pixel(pixel);
    T sin_lambda, cos_lambda, sin_phi, cos_phi;
    sin_cos_signed(point.u, sin_lambda, cos_lambda);
    sin_cos_signed(point.v, sin_phi, cos_phi);
    const T outward = grad_ray.x * sin_lambda + grad_ray.z * cos_lambda;
    const T grad_lambda = cos_phi * (grad_ray.x * cos_lambda - grad_ray.z * sin_lambda);
    this->from_pixel_adjoint(pixel, Point<T>{grad_lambda, grad_ray.y * cos_phi - outward * sin_phi}, grad_params);
  }

 private:
  template <class T>
  FISHEYEREC_INLINE static Point<T> longitude_and_latitude(const Ray<T>& ray, T h) {
    return {atan2_signed(ray.x, ray.z), atan2_signed(ray.y, h)};
  }
};

}  // namespace fisheyerec
