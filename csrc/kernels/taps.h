// Where and how a run of coordinates reads an image: shared by all channels, and by forward and backward.
#pragma once

#include "../geometry/interpolation.h"
#include "map.h"
#include "storage.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

template <class S>
struct Taps {
  alignas(64) int64_t at[run_length];      // element offset of the upper left neighbour from the image's first pixel
  alignas(64) S weight[2][2][run_length];  // [y][x]
  alignas(64) S slope_x[2][2][run_length], slope_y[2][2][run_length];
  alignas(64) int32_t row[run_length];   // of the upper left neighbour
  alignas(64) int32_t live[run_length];  // -1, or 0 where nothing is read: the result is 0
  int64_t right, below;                  // offsets to the other neighbours; 0 where there is none
  bool two_rows;                         // there are lower neighbours (below may be 0 for a repeated row)
};

// Calls tap for each coordinate of the run and writes what taps need to know. slopes: also slope_x and slope_y.
// Offset: an integer vector that holds every offset within the image.
template <class Offset, class S, class TapFunction>
FISHEYEREC_INLINE void take_taps(const Image& source, int count, const S* x, const S* y, bool slopes, Taps<S>& taps,
                                 const TapFunction& tap) {
  using T = Pack<S>;
  const int width = static_cast<int>(source.width), height = static_cast<int>(source.height);
  const Offset stride_x = splat<Offset>(source.stride_x), stride_y = splat<Offset>(source.stride_y);
  for (int i = 0; i < count; i += lanes<T>) {
    const Tap<T> h = tap(load_lanes<T>(x + i), width), v = tap(load_lanes<T>(y + i), height);
    const Mask<T> live = h.live & v.live;
    const Offset at = convert<Offset>(v.index) * stride_y + convert<Offset>(h.index) * stride_x;
    store_lanes(taps.at + i, convert<Like<int64_t, T>>(at));
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
}

// Whether offsets within one image of the batch fit into 32 bits, whose vectors multiply several times as fast.
inline bool has_narrow_offsets(const Image& image) {
  const auto reach = [](int64_t size, int64_t stride) { return (size - 1) * (stride < 0 ? -stride : stride); };
  constexpr int64_t limit = int64_t{1} << 30;
  return reach(image.height, image.stride_y) < limit && reach(image.width, image.stride_x) < limit;
}

// Whether all neighbours of the whole run lie inside the image, as they mostly do.
template <class S>
FISHEYEREC_NOINLINE bool is_interior(const Image& source, int count, const S* x, const S* y) {
  using T = Pack<S>;
  const T zero = splat<T>(0), last_x = splat<T>(source.width - 1), last_y = splat<T>(source.height - 1);
  Mask<T> interior = zero == zero;
  for (int i = 0; i < count; i += lanes<T>) {
    const T u = load_lanes<T>(x + i), v = load_lanes<T>(y + i);
    interior = interior & (u >= zero) & (u < last_x) & (v >= zero) & (v < last_y);
  }
  alignas(64) int32_t lane_is_interior[lanes<T>];
  store_lanes(lane_is_interior, select(interior, splat<Index<T>>(1), splat<Index<T>>(0)));
  int all = 1;
  for (const int32_t lane : lane_is_interior) all &= lane;
  return all != 0;
}

template <class S>
FISHEYEREC_NOINLINE void take_taps(const Image& source, Interpolation interpolation, Padding padding, bool interior,
                                   int count, const S* x, const S* y, bool slopes, Taps<S>& taps) {
  using T = Pack<S>;
  const bool linear = interpolation == Interpolation::bilinear;
  taps.right = linear && source.width > 1 ? source.stride_x : 0;
  taps.two_rows = linear && source.height > 1;
  taps.below = taps.two_rows ? source.stride_y : 0;
  const auto take = [&](const auto& tap) {
    if (has_narrow_offsets(source)) {
      take_taps<Like<int32_t, T>>(source, count, x, y, slopes, taps, tap);
    } else {
      take_taps<Like<int64_t, T>>(source, count, x, y, slopes, taps, tap);
    }
  };
  if (!linear) {
    const bool extend = padding == Padding::border;
    take([extend](T coordinate, int size) { return nearest_tap(coordinate, size, extend); });
  } else if (interior) {
    take([](T coordinate, int) { return linear_tap_interior(coordinate); });
  } else if (padding == Padding::zeros) {
    take([](T coordinate, int size) { return linear_tap_zeros(coordinate, size); });
  } else {
    take([](T coordinate, int size) { return linear_tap_border(coordinate, size); });
  }
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
