// Where and how a run of coordinates reads an image: shared by all channels, and by forward and backward.
#pragma once

#include "../geometry/interpolation.h"
#include "map.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

template <class S>
struct Taps {
  alignas(64) int64_t at[run_length];      // element offset of the upper left neighbour from the image's first pixel
  alignas(64) S weight[2][2][run_length];  // [y][x]
  alignas(64) S slope_x[2][2][run_length], slope_y[2][2][run_length];
  alignas(64) int32_t row[run_length];  // of the upper left neighbour
  alignas(64) int32_t column[run_length];
  alignas(64) int32_t live[run_length];  // -1, or 0 where nothing is read: the result is 0
  int64_t right, below;                  // offsets to the other neighbours, 0 for an image one pixel wide or high
};

// slopes: also fill slope_x and slope_y.
template <class S>
void take_taps(const Image& source, Interpolation interpolation, Padding padding, int count, const S* x, const S* y,
               bool slopes, Taps<S>& taps) {
  using T = Pack<S>;
  const int width = static_cast<int>(source.width), height = static_cast<int>(source.height);
  taps.right = width > 1 ? source.stride_x : 0;
  taps.below = height > 1 ? source.stride_y : 0;
  const auto take = [&](auto tap) {
    for (int i = 0; i < count; i += lanes<T>) {
      const Tap<T> h = tap(load_lanes<T>(x + i), width), v = tap(load_lanes<T>(y + i), height);
      const Mask<T> live = h.live & v.live;
      store_lanes(taps.column + i, h.index);
      store_lanes(taps.row + i, v.index);
      store_lanes(taps.live + i, select(live, splat<Index<T>>(-1), splat<Index<T>>(0)));
      for (int b = 0; b < 2; ++b) {
        for (int a = 0; a < 2; ++a) {
          store_lanes(taps.weight[b][a] + i, v.weight[b] * h.weight[a]);
          if (slopes) {
            store_lanes(taps.slope_x[b][a] + i, v.weight[b] * h.slope[a]);
            store_lanes(taps.slope_y[b][a] + i, v.slope[b] * h.weight[a]);
          }
        }
      }
    }
  };
  if (interpolation == Interpolation::nearest) {
    const bool extend = padding == Padding::border;
    take([extend](T coordinate, int size) { return nearest_tap(coordinate, size, extend); });
  } else if (padding == Padding::zeros) {
    take([](T coordinate, int size) { return linear_tap_zeros(coordinate, size); });
  } else {
    take([](T coordinate, int size) { return linear_tap_border(coordinate, size); });
  }
  const int64_t stride_x = source.stride_x, stride_y = source.stride_y;
  for (int i = 0; i < count; ++i) taps.at[i] = taps.row[i] * stride_y + taps.column[i] * stride_x;
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
