// Interpolation along one axis: which pixels a coordinate reads, and with which weights.
#pragma once

#include "pixel.h"

namespace fisheyerec {

//      value       = weight[0] v[index] + weight[1] v[index + step]
//      dvalue / dx =  slope[0] v[index] +  slope[1] v[index + step]
// index and index + step always lie inside the image; a neighbour outside it has weight and slope 0.
template <class T>
struct Tap {
  int index;
  int step;  // 0 or 1
  T weight[2];
  T slope[2];
  bool live;  // false where nothing is read, which includes NaN
};

// Linear, and outside the image lies 0: the value fades out over the pixel beyond the edge. Eq. 4 of FishEyeRecNet,
// with floor + 1 in place of the ceiling, whose gradient would vanish at integer coordinates.
template <class T>
FISHEYEREC_INLINE Tap<T> linear_tap_zeros(T x, int size) {
  const bool live = x > T(-1) && x < static_cast<T>(size);
  const T safe = live ? x : T(0);
  const int truncated = static_cast<int>(safe);
  const int floor = safe < static_cast<T>(truncated) ? truncated - 1 : truncated;
  const T fraction = safe - static_cast<T>(floor);
  const bool has_low = floor >= 0, has_high = floor + 1 < size;
  const T low = live && has_low ? T(1) : T(0), high = live && has_high ? T(1) : T(0);
  return {
      has_low ? floor : 0, has_low && has_high ? 1 : 0, {low * (1 - fraction), high * fraction}, {-low, high}, live};
}

// Linear, and the image's edge goes on for ever.
template <class T>
FISHEYEREC_INLINE Tap<T> linear_tap_border(T x, int size) {
  const T last = static_cast<T>(size - 1);
  const bool moving = x >= 0 && x <= last;
  const T clamped = x > 0 ? (x < last ? x : last) : T(0);
  const int floor = static_cast<int>(clamped);
  const T fraction = clamped - static_cast<T>(floor);
  const T slope = moving ? T(1) : T(0);
  return {floor, floor + 1 < size ? 1 : 0, {1 - fraction, fraction}, {-slope, slope}, x == x};
}

// The pixel that contains x; beyond the edge, the edge's where `extend`, else nothing.
template <class T>
FISHEYEREC_INLINE Tap<T> nearest_tap(T x, int size, bool extend) {
  const T last = static_cast<T>(size - 1);
  const bool live = extend ? x == x : inside(x, static_cast<T>(size));
  const T clamped = x > 0 ? (x < last ? x : last) : T(0);
  return {nearest_index(clamped, size), 0, {live ? T(1) : T(0), 0}, {0, 0}, live};
}

}  // namespace fisheyerec
