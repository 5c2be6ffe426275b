// The pinhole camera:  x = fx X/Z + cx,  y = fy Y/Z + cy.
#pragma once

#include "pixel.h"

namespace fisheyerec {

template <class S>
struct Pinhole {
  static constexpr int parameter_count = 4;
  S fx, fy, cx, cy;

  static Pinhole make(const double* params) {
    return {static_cast<S>(params[0]), static_cast<S>(params[1]), static_cast<S>(params[2]), static_cast<S>(params[3])};
  }

  // Rays on or behind the image plane are invalid.
  template <class T>
  FISHEYEREC_INLINE Mask<T> project(const Ray<T>& ray, Pixel<T>& pixel) const {
    const T inverse_z = S(1) / ray.z;
    pixel.x = cx + fx * (ray.x * inverse_z);
    pixel.y = cy + fy * (ray.y * inverse_z);
    return ray.z > splat<T>(0);
  }

  template <class T>
  FISHEYEREC_INLINE void project_adjoint(const Ray<T>& ray, const Pixel<T>& grad_pixel, Ray<T>& grad_ray,
                                         T* grad_params) const {
    const T inverse_z = S(1) / ray.z;
    const T x = ray.x * inverse_z, y = ray.y * inverse_z;
    const T grad_x = grad_pixel.x * fx, grad_y = grad_pixel.y * fy;
    grad_params[0] += grad_pixel.x * x;
    grad_params[1] += grad_pixel.y * y;
    grad_params[2] += grad_pixel.x;
    grad_params[3] += grad_pixel.y;
    grad_ray.x += grad_x * inverse_z;
    grad_ray.y += grad_y * inverse_z;
    grad_ray.z -= (grad_x * x + grad_y * y) * inverse_z;
  }

  // The ray has Z = 1, not unit length.
  template <class T>
  FISHEYEREC_INLINE Mask<T> unproject(const Pixel<T>& pixel, Ray<T>& ray) const {
    ray = {(pixel.x - cx) / fx, (pixel.y - cy) / fy, splat<T>(1)};
    return ray.z > splat<T>(0);
  }

  template <class T>
  FISHEYEREC_INLINE void unproject_adjoint(const Pixel<T>& pixel, const Ray<T>& grad_ray, T* grad_params) const {
    const T grad_x = grad_ray.x / fx, grad_y = grad_ray.y / fy;
    grad_params[0] -= grad_x * ((pixel.x - cx) / fx);
    grad_params[1] -= grad_y * ((pixel.y - cy) / fy);
    grad_params[2] -= grad_x;
    grad_params[3] -= grad_y;
  }
};

}  // namespace fisheyerec
