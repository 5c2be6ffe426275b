// Reading (and, in the adjoint, writing) the source image at a run of coordinates.
#pragma once

#include "../geometry/interpolation.h"
#include "half.h"
#include "map.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

// A run of taps in two dimensions: element offsets from the image's first pixel, and weights per axis. Shared by
// all channels, and by forward and backward.
template <class T>
struct Taps {
  int64_t at[run_length];     // the upper left neighbour
  int64_t right[run_length];  // offset to its right neighbour, 0 at the edge
  int64_t below[run_length];  // offset to its lower neighbour, 0 at the edge
  T weight_x[2][run_length], weight_y[2][run_length];
  T slope_x[2][run_length], slope_y[2][run_length];
  int row[run_length];    // row of the upper left neighbour
  bool live[run_length];  // false where nothing is read: the result is 0
};

template <class T>
void take_taps(const Image& source, Interpolation interpolation, Padding padding, int count, const T* x, const T* y,
               Taps<T>& taps) {
  const int width = static_cast<int>(source.width), height = static_cast<int>(source.height);
  const auto take = [&](auto tap) {
#pragma omp simd
    for (int i = 0; i < count; ++i) {
      const Tap<T> h = tap(x[i], width), v = tap(y[i], height);
      taps.at[i] = v.index * source.stride_y + h.index * source.stride_x;
      taps.right[i] = h.step * source.stride_x;
      taps.below[i] = v.step * source.stride_y;
      taps.row[i] = v.index;
      taps.live[i] = h.live && v.live;
      for (int side = 0; side < 2; ++side) {
        taps.weight_x[side][i] = h.weight[side];
        taps.weight_y[side][i] = v.weight[side];
        taps.slope_x[side][i] = h.slope[side];
        taps.slope_y[side][i] = v.slope[side];
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
}

// The four neighbours of one channel around pixel i.
template <class T, class D>
struct Neighbours {
  T v[2][2];  // [y][x]

  FISHEYEREC_INLINE Neighbours(const D* channel, const Taps<T>& taps, int i) {
    const D* p = channel + taps.at[i];
    v[0][0] = load<T>(p[0]);
    v[0][1] = load<T>(p[taps.right[i]]);
    v[1][0] = load<T>(p[taps.below[i]]);
    v[1][1] = load<T>(p[taps.below[i] + taps.right[i]]);
  }
};

// weights_y' V weights_x
template <class T, class D>
FISHEYEREC_INLINE T blend(const Neighbours<T, D>& n, const T (&wx)[2][run_length], const T (&wy)[2][run_length],
                          int i) {
  return wy[0][i] * (wx[0][i] * n.v[0][0] + wx[1][i] * n.v[0][1]) +
         wy[1][i] * (wx[0][i] * n.v[1][0] + wx[1][i] * n.v[1][1]);
}

// target[c][i] = sum of weighted neighbours.
template <class T, class D>
void sample_run(const Image& source, const D* source_pixels, const Taps<T>& taps, int count, const Image& target,
                D* target_pixels) {
  const auto sample = [&](const D* channel, int i) {
    const Neighbours<T, D> neighbours(channel, taps, i);
    return Store<D, T>::from(taps.live[i] ? blend(neighbours, taps.weight_x, taps.weight_y, i) : T(0));
  };
  if (target.interleaved()) {
    for (int i = 0; i < count; ++i) {
      D* out = target_pixels + i * target.stride_x;
#pragma omp simd
      for (int64_t c = 0; c < source.channels; ++c) {
        out[c * target.stride_channel] = sample(source_pixels + c * source.stride_channel, i);
      }
    }
  } else {
    for (int64_t c = 0; c < source.channels; ++c) {
      const D* channel = source_pixels + c * source.stride_channel;
      D* out = target_pixels + c * target.stride_channel;
#pragma omp simd
      for (int i = 0; i < count; ++i) out[i * target.stride_x] = sample(channel, i);
    }
  }
}

// grad_x[i] = sum over channels of grad_target[c][i] dtarget[c][i]/dx[i]  (Eq. 7 of FishEyeRecNet), likewise grad_y.
template <class T, class D>
void sample_run_adjoint_coordinates(const Image& source, const D* source_pixels, const Taps<T>& taps, int count,
                                    const Image& grad_target, const D* grad_pixels, T* grad_x, T* grad_y) {
  const auto add = [&](int64_t c, int i, T& sum_x, T& sum_y) {
    const Neighbours<T, D> neighbours(source_pixels + c * source.stride_channel, taps, i);
    const T g = load<T>(grad_pixels[c * grad_target.stride_channel + i * grad_target.stride_x]);
    sum_x += g * blend(neighbours, taps.slope_x, taps.weight_y, i);
    sum_y += g * blend(neighbours, taps.weight_x, taps.slope_y, i);
  };
  if (grad_target.interleaved()) {
    for (int i = 0; i < count; ++i) {
      T sum_x[lanes] = {}, sum_y[lanes] = {};
      for (int64_t begin = 0; begin < source.channels; begin += lanes) {
        const int64_t width = source.channels - begin < lanes ? source.channels - begin : lanes;
#pragma omp simd
        for (int64_t lane = 0; lane < width; ++lane) add(begin + lane, i, sum_x[lane], sum_y[lane]);
      }
      grad_x[i] = grad_y[i] = 0;
      for (int lane = 0; lane < lanes; ++lane) grad_x[i] += sum_x[lane], grad_y[i] += sum_y[lane];
    }
  } else {
    for (int i = 0; i < count; ++i) grad_x[i] = grad_y[i] = 0;
    for (int64_t c = 0; c < source.channels; ++c) {
#pragma omp simd
      for (int i = 0; i < count; ++i) add(c, i, grad_x[i], grad_y[i]);
    }
  }
  for (int i = 0; i < count; ++i) {
    if (!taps.live[i]) grad_x[i] = grad_y[i] = 0;
  }
}

// grad_source += weights * grad_target (Eq. 5 of FishEyeRecNet), only into rows [row_begin, row_end).
template <class T, class D>
void sample_run_adjoint_image(const Image& grad_source, T* grad_source_pixels, const Taps<T>& taps, int count,
                              const Image& grad_target, const D* grad_pixels, int row_begin, int row_end) {
  const auto scatter = [&](int i, auto&& add) {  // add(offset, weight) for the taps in this band's rows
    if (!taps.live[i]) return;
    for (int side = 0; side < 2; ++side) {
      const int row = taps.row[i] + (side && taps.below[i] ? 1 : 0);
      const int64_t at = taps.at[i] + (side ? taps.below[i] : 0);
      const T wy = taps.weight_y[side][i];
      if (row < row_begin || row >= row_end) continue;
      add(at, wy * taps.weight_x[0][i]);
      add(at + taps.right[i], wy * taps.weight_x[1][i]);
    }
  };
  if (grad_target.interleaved()) {
    for (int i = 0; i < count; ++i) {
      const D* g = grad_pixels + i * grad_target.stride_x;
      scatter(i, [&](int64_t offset, T weight) {
        T* out = grad_source_pixels + offset;
#pragma omp simd
        for (int64_t c = 0; c < grad_source.channels; ++c) {
          out[c * grad_source.stride_channel] += weight * load<T>(g[c * grad_target.stride_channel]);
        }
      });
    }
  } else {
    for (int64_t c = 0; c < grad_source.channels; ++c) {
      T* channel = grad_source_pixels + c * grad_source.stride_channel;
      const D* g = grad_pixels + c * grad_target.stride_channel;
      for (int i = 0; i < count; ++i) {
        const T gradient = load<T>(g[i * grad_target.stride_x]);
        scatter(i, [&](int64_t offset, T weight) { channel[offset] += weight * gradient; });
      }
    }
  }
}

// target[c][i] = the nearest pixel. D only carries bytes, so that any type of label survives.
template <class T, class D>
void copy_run(const Image& source, const D* source_pixels, const Taps<T>& taps, int count, const Image& target,
              D* target_pixels) {
  const auto copy = [&](int64_t c, int i) {
    target_pixels[c * target.stride_channel + i * target.stride_x] =
        taps.live[i] ? source_pixels[c * source.stride_channel + taps.at[i]] : D{};
  };
  if (target.interleaved()) {
    for (int i = 0; i < count; ++i) {
      for (int64_t c = 0; c < source.channels; ++c) copy(c, i);
    }
  } else {
    for (int64_t c = 0; c < source.channels; ++c) {
      for (int i = 0; i < count; ++i) copy(c, i);
    }
  }
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
