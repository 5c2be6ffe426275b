// Angles of rays. double takes the C library; float takes polynomials without branches, so that a loop over
// pixels becomes vector instructions.
#pragma once

#include "pixel.h"

namespace fisheyerec {

template <class T>
constexpr T pi = T(3.14159265358979323846);

// atan2(y, x) for y >= 0: an angle in [0, pi].
FISHEYEREC_INLINE double atan2_upper(double y, double x) { return std::atan2(y, x); }

FISHEYEREC_INLINE float atan2_upper(float y, float x) {
  // atan(t) = t (1 + u P(u)), u = t^2, on t in [0, 1]: minimax, relative error 5e-9 before rounding.
  const float abs_x = x < 0 ? -x : x;
  const bool steep = y > abs_x;
  const float large = steep ? y : abs_x;
  const float small = steep ? abs_x : y;
  const float t = large > 0 ? small / large : 0.0f;
  const float u = t * t;
  float p = -0.0017437011701986194f;
  p = p * u + 0.010748500004410744f;
  p = p * u - 0.030991289764642715f;
  p = p * u + 0.05791354179382324f;
  p = p * u - 0.08410654217004776f;
  p = p * u + 0.10958582162857056f;
  p = p * u - 0.14266346395015717f;
  p = p * u + 0.19998842477798462f;
  p = p * u - 0.3333331346511841f;
  const float octant = t + t * (u * p);
  const float quadrant = steep ? pi<float> / 2 - octant : octant;
  return x < 0 ? pi<float> - quadrant : quadrant;
}

// sin(theta) and cos(theta) for theta in [0, pi].
FISHEYEREC_INLINE void sin_cos(double theta, double& sin_theta, double& cos_theta) {
  sin_theta = std::sin(theta);
  cos_theta = std::cos(theta);
}

FISHEYEREC_INLINE void sin_cos(float theta, float& sin_theta, float& cos_theta) {
  // theta = j pi/2 + rho with |rho| <= pi/4. pi/2 is split in two so that rho keeps its last bits.
  constexpr float half_pi_high = 1.57079637f, half_pi_low = -4.37113883e-8f;
  const bool beyond_45_deg = theta > pi<float> / 4;
  const bool beyond_135_deg = theta > 3 * pi<float> / 4;
  const float j = beyond_135_deg ? 2.0f : beyond_45_deg ? 1.0f : 0.0f;
  const float rho = (theta - j * half_pi_high) - j * half_pi_low;
  const float u = rho * rho;
  // Minimax on |rho| <= pi/4, relative errors 6e-9 and 2e-10 before rounding.
  const float s = rho + rho * (u * (-0.16666655242443085f + u * (0.008332100696861744f - u * 0.0001950396253960207f)));
  const float c =
      1.0f - u / 2 + u * u * (0.041666653007268906f + u * (-0.0013887654058635235f + u * 2.446383768983651e-05f));
  sin_theta = beyond_135_deg ? -s : beyond_45_deg ? c : s;
  cos_theta = beyond_135_deg ? -c : beyond_45_deg ? -s : c;
}

}  // namespace fisheyerec
