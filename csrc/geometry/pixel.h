// The conventions of the whole project. They are stated here once; every other file includes this one.
//
// Pixels   Integer coordinates are pixel CENTRES: an image of width W spans [-0.5, W - 0.5] and its centre is
//          (W - 1) / 2. This is OpenCV's convention; COLMAP's origin lies half a pixel further up and left.
// Frames   x right, y down, z forward. theta is the angle between a ray and +z, in radians, [0, pi].
// Order    pinhole and other views: fx, fy, cx, cy (Panini: d).   Kannala-Brandt: fx, fy, cx, cy, k1, k2, k3, k4.
// Invalid  is a value: projections answer `bool`, and every comparison is written so that NaN falls on the
//          invalid side.
//
// Tier 1: the maths of one pixel or ray, templated on the number type (lanes.h), <cmath> only. Each function stands
// above its adjoint, which takes the same arguments, then the incoming gradient, and accumulates into the outgoing
// ones.
#pragma once

#include "lanes.h"

namespace fisheyerec {

template <class T>
struct Pixel {
  T x, y;
};

template <class T>
struct Ray {
  T x, y, z;
};

// The half pixel of the convention above: from the centre of a pixel to its edge.
template <class T>
constexpr Scalar<T> half_pixel = Scalar<T>(0.5);

// Whether coordinate x lies on an image that is `size` pixels wide (or high).
template <class T>
FISHEYEREC_INLINE Mask<T> inside(T x, Scalar<T> size) {
  return (x >= -half_pixel<T>)&(x <= size - half_pixel<T>);
}

// The integer pixel that contains coordinate x, which must lie in [0, size - 1]. Not truncate(x + 1/2): in float that
// sum rounds up to the next integer for large x.
template <class T>
FISHEYEREC_INLINE Index<T> nearest_index(T x) {
  const Index<T> whole = truncate(x);
  const Index<T> none = splat<Index<T>>(0);
  return whole + select(x - to_real<T>(whole) >= splat<T>(half_pixel<T>), none + 1, none);
}

// ray_source = R ray_target, R row-major.
template <class T>
FISHEYEREC_INLINE Ray<T> rotate(const Scalar<T>* R, const Ray<T>& ray) {
  return {R[0] * ray.x + R[1] * ray.y + R[2] * ray.z, R[3] * ray.x + R[4] * ray.y + R[5] * ray.z,
          R[6] * ray.x + R[7] * ray.y + R[8] * ray.z};
}

template <class T>
FISHEYEREC_INLINE void rotate_adjoint(const Scalar<T>* R, const Ray<T>& ray, const Ray<T>& grad_rotated,
                                      Ray<T>& grad_ray, T* grad_R) {
  const Ray<T>& g = grad_rotated;
  grad_ray.x += R[0] * g.x + R[3] * g.y + R[6] * g.z;
  grad_ray.y += R[1] * g.x + R[4] * g.y + R[7] * g.z;
  grad_ray.z += R[2] * g.x + R[5] * g.y + R[8] * g.z;
  const T outer[9] = {g.x * ray.x, g.x * ray.y, g.x * ray.z, g.y * ray.x, g.y * ray.y,
                      g.y * ray.z, g.z * ray.x, g.z * ray.y, g.z * ray.z};
  for (int i = 0; i < 9; ++i) grad_R[i] += outer[i];
}

}  // namespace fisheyerec
