// What views share: pixels on a plane where the projection has focal length 1,  x = fx u + cx,  y = fy v + cy.
#pragma once

#include "trigonometry.h"

namespace fisheyerec {

template <class S>
struct ImagePlane {
  S fx, fy, cx, cy;

  static ImagePlane make(const double* params) {
    return {static_cast<S>(params[0]), static_cast<S>(params[1]), static_cast<S>(params[2]), static_cast<S>(params[3])};
  }

  template <class T>
  struct Point {
    T u, v;
  };

  template <class T>
  FISHEYEREC_INLINE Point<T> from_pixel(const Pixel<T>& pixel) const {
    return {(pixel.x - cx) / fx, (pixel.y - cy) / fy};
  }

  template <class T>
  FISHEYEREC_INLINE void from_pixel_adjoint(const Pixel<T>& pixel, const Point<T>& grad_point, T* grad_params) const {
    const T grad_x = grad_point.u / fx, grad_y = grad_point.v / fy;
    grad_params[0] -= grad_x * ((pixel.x - cx) / fx);
    grad_params[1] -= grad_y * ((pixel.y - cy) / fy);
    grad_params[2] -= grad_x;
    grad_params[3] -= grad_y;
  }

  template <class T>
  FISHEYEREC_INLINE Pixel<T> to_pixel(const Point<T>& point) const {
    return {cx + fx * point.u, cy + fy * point.v};
  }

  // Gives the gradient to the point.
  template <class T>
  FISHEYEREC_INLINE Point<T> to_pixel_adjoint(const Point<T>& point, const Pixel<T>& grad_pixel, T* grad_params) const {
    grad_params[0] += grad_pixel.x * point.u;
    grad_params[1] += grad_pixel.y * point.v;
    grad_params[2] += grad_pixel.x;
    grad_params[3] += grad_pixel.y;
    return {grad_pixel.x * fx, grad_pixel.y * fy};
  }
};

}  // namespace fisheyerec
