// Angles of rays. double takes the C library; float and vectors of floats take polynomials without branches.
#pragma once

#include "pixel.h"

namespace fisheyerec {

template <class S>
constexpr S pi = S(3.14159265358979323846);

// atan2(y, x) for y >= 0: an angle in [0, pi].
FISHEYEREC_INLINE double atan2_upper(double y, double x) { return std::atan2(y, x); }

template <class T>
FISHEYEREC_INLINE T atan2_upper(T y, T x) {
  // atan(t) = t (1 + u P(u)), u = t^2, on t in [0, 1]: minimax, relative error 5e-9 before rounding.
  const T zero = splat<T>(0);
  const T abs_x = select(x < zero, -x, x);
  const Mask<T> steep = y > abs_x;
  const T large = select(steep, y, abs_x);
  const T small = select(steep, abs_x, y);
  const T t = select(large == zero, zero, small / large);  // NaN stays NaN
  const T u = t * t;
  T p = u * -0.0017437011701986194f + 0.010748500004410744f;
  p = p * u - 0.030991289764642715f;
  p = p * u + 0.05791354179382324f;
  p = p * u - 0.08410654217004776f;
  p = p * u + 0.10958582162857056f;
  p = p * u - 0.14266346395015717f;
  p = p * u + 0.19998842477798462f;
  p = p * u - 0.3333331346511841f;
  const T octant = t + t * (u * p);
  const T quadrant = select(steep, pi<float> / 2 - octant, octant);
  return select(x < zero, pi<float> - quadrant, quadrant);
}

// atan2(y, x) in [-pi, pi].
template <class T>
FISHEYEREC_INLINE T atan2_signed(T y, T x) {
  const Mask<T> below = y < splat<T>(0);
  const T angle = atan2_upper(select(below, -y, y), x);
  return select(below, -angle, angle);
}

// sin(theta) and cos(theta) for theta in [0, pi].
FISHEYEREC_INLINE void sin_cos(double theta, double& sin_theta, double& cos_theta) {
  sin_theta = std::sin(theta);
  cos_theta = std::cos(theta);
}

template <class T>
FISHEYEREC_INLINE void sin_cos(T theta, T& sin_theta, T& cos_theta) {
  // theta = j pi/2 + rho with |rho| <= pi/4. pi/2 is split in two so that rho keeps its last bits.
  constexpr float half_pi_high = 1.57079637f, half_pi_low = -4.37113883e-8f;
  const T zero = splat<T>(0), one = splat<T>(1);
  const Mask<T> beyond_45_deg = theta > splat<T>(pi<float> / 4);
  const Mask<T> beyond_135_deg = theta > splat<T>(3 * pi<float> / 4);
  const T j = select(beyond_45_deg, one, zero) + select(beyond_135_deg, one, zero);
  const T rho = (theta - j * half_pi_high) - j * half_pi_low;
  const T u = rho * rho;
  // Minimax on |rho| <= pi/4, relative errors 6e-9 and 2e-10 before rounding.
  const T s = rho + rho * (u * (-0.16666655242443085f + u * (0.008332100696861744f - u * 0.0001950396253960207f)));
  const T c =
      1.0f - u * 0.5f + u * u * (0.041666653007268906f + u * (-0.0013887654058635235f + u * 2.446383768983651e-05f));
  sin_theta = select(beyond_135_deg, -s, select(beyond_45_deg, c, s));
  cos_theta = select(beyond_135_deg, -c, select(beyond_45_deg, -s, c));
}

// The same for theta in [-pi, pi].
template <class T>
FISHEYEREC_INLINE void sin_cos_signed(T theta, T& sin_theta, T& cos_theta) {
  const Mask<T> below = theta < splat<T>(0);
  sin_cos(select(below, -theta, theta), sin_theta, cos_theta);
  sin_theta = select(below, -sin_theta, sin_theta);
}

}  // namespace fisheyerec
