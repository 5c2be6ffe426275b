// Interpolation along one axis: which pixels a coordinate reads, and with which weights.
#pragma once

#include "pixel.h"

namespace fisheyerec {

//      value       = weight[0] v[index] + weight[1] v[index + 1]
//      dvalue / dx =  slope[0] v[index] +  slope[1] v[index + 1]
// Both neighbours always lie inside the image, also for a coordinate at its edge or beyond: a neighbour that is not
// wanted has weight and slope 0. (An image one pixel wide has index 0 only; its second neighbour has weight 0.)
template <class T>
struct Tap {
  Index<T> index;  // in [0, max(size - 2, 0)] where linear, in [0, size - 1] where nearest
  T weight[2];
  T slope[2];
  Mask<T> live;  // false where nothing is read, which includes NaN
};

// Linear, for a coordinate known to lie in [0, size - 1): what the other two agree on there.
template <class T>
FISHEYEREC_INLINE Tap<T> linear_tap_interior(T x) {
  const T one = splat<T>(1);
  const Index<T> floor = truncate(x);
  const T fraction = x - to_real<T>(floor);
  return {floor, {one - fraction, fraction}, {-one, one}, x == x};
}

// The neighbours of floor(x) = base, moved inside the image: base -1 and size - 1 have one neighbour there.
template <class T>
FISHEYEREC_INLINE Tap<T> edge_tap(Index<T> base, T low, T high, T low_slope, T high_slope, Mask<T> live, int size) {
  const T zero = splat<T>(0);
  const Index<T> first = splat<Index<T>>(0), last = splat<Index<T>>(size > 1 ? size - 2 : 0);
  const Mask<T> before = base<first, after = base> last;
  const Index<T> index = select(before, first, select(after, last, base));
  // An image one pixel wide keeps base 0 in place: `after` is then false for it.
  return {index,
          {select(before, high, select(after, zero, low)), select(before, zero, select(after, low, high))},
          {select(before, high_slope, select(after, zero, low_slope)),
           select(before, zero, select(after, low_slope, high_slope))},
          live};
}

// Linear, and outside the image lies 0: the value fades out over the pixel beyond the edge. Eq. 4 of FishEyeRecNet,
// with floor + 1 in place of the ceiling, whose gradient would vanish at integer coordinates.
template <class T>
FISHEYEREC_INLINE Tap<T> linear_tap_zeros(T x, int size) {
  const T zero = splat<T>(0), one = splat<T>(1);
  const Index<T> none = splat<Index<T>>(0);
  const Mask<T> live = (x > -one) & (x < splat<T>(size));
  const T safe = select(live, x, zero);
  const Index<T> truncated = truncate(safe);
  const Index<T> floor = truncated - select(safe < to_real<T>(truncated), none + 1, none);
  const T fraction = safe - to_real<T>(floor);
  const T weight = select(live, one, zero), last = select(floor < splat<Index<T>>(size - 1), weight, zero);
  return edge_tap<T>(floor, weight * (one - fraction), last * fraction, -weight, last, live, size);
}

// Linear, and the image's edge goes on for ever.
template <class T>
FISHEYEREC_INLINE Tap<T> linear_tap_border(T x, int size) {
  const T zero = splat<T>(0), one = splat<T>(1), end = splat<T>(size - 1);
  const T clamped = select(x > zero, select(x < end, x, end), zero);
  const Index<T> floor = truncate(clamped);
  const T fraction = clamped - to_real<T>(floor);
  const T slope = select((x >= zero) & (x < end), one, zero);
  return edge_tap<T>(floor, one - fraction, fraction, -slope, slope, x == x, size);
}

// The pixel that contains x; beyond the edge, the edge's where `extend`, else nothing. There is no second neighbour:
// index may be size - 1.
template <class T>
FISHEYEREC_INLINE Tap<T> nearest_tap(T x, int size, bool extend) {
  const T zero = splat<T>(0), one = splat<T>(1), end = splat<T>(size - 1);
  const Mask<T> live = extend ? x == x : inside(x, static_cast<Scalar<T>>(size));
  const T clamped = select(x > zero, select(x < end, x, end), zero);
  // Beyond 2^24 pixels, size - 1 may be no float and round up.
  const Index<T> index = nearest_index(clamped), last = splat<Index<T>>(size - 1);
  return {select(index < last, index, last), {select(live, one, zero), zero}, {zero, zero}, live};
}

}  // namespace fisheyerec
