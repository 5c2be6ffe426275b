// Reading (and, in the adjoint, writing) the source image at a run of taps.
//
// Two layouts. Planar: channels lie apart, vectors run over the pixels of the run, which read from all over the
// image. Interleaved: channels lie side by side, vectors run over the channels of one pixel.
#pragma once

#include "storage.h"
#include "taps.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

// Few channels are handled four at a time, many in full vectors.
constexpr int few_channels = 4;
template <class S>
using FewChannels = std::conditional_t<sizeof(S) == 8, double, typename VectorOf<float, few_channels>::type>;

template <class T, class Lane, int... lane>
FISHEYEREC_INLINE T from_lanes(const Lane& at_lane, std::integer_sequence<int, lane...>) {
  if constexpr (is_vector<T>) {
    return T{at_lane(lane)...};
  } else {
    return at_lane(0);
  }
}

// T with at_lane(0), at_lane(1), ... in its lanes.
template <class T, class Lane>
FISHEYEREC_INLINE T from_lanes(const Lane& at_lane) {
  constexpr int count = is_vector<T> ? sizeof(T) / sizeof(at_lane(0)) : 1;
  return from_lanes<T>(at_lane, std::make_integer_sequence<int, count>{});
}

#if defined(__clang__) || __GNUC__ >= 12
template <int first, class T, int... lane>
FISHEYEREC_INLINE T every_second(const T& a, const T& b, std::integer_sequence<int, lane...>) {
  return __builtin_shufflevector(a, b, (2 * lane + first)...);
}
#else
template <int first, class T, int... lane>
FISHEYEREC_INLINE T every_second(const T& a, const T& b, std::integer_sequence<int, lane...>) {
  return __builtin_shuffle(a, b, Index<T>{(2 * lane + first)...});
}
#endif

// The four neighbours of the pixels i, i + 1, ... of a run in one channel.
template <class T>
struct Neighbours {
  T v[2][2];  // [y][x]
};

template <class T, class D>
FISHEYEREC_INLINE Neighbours<T> gather(const D* channel, const Taps<Scalar<T>>& taps, int i) {
  Neighbours<T> n;
  if constexpr (is_vector<T> && std::is_same_v<D, float>) {
    if (taps.right == 1) {  // both horizontal neighbours in one load of 64 bits
      using Pairs = typename VectorOf<uint64_t, lanes<T> / 2>::type;
      constexpr auto all = std::make_integer_sequence<int, lanes<T>>{};
      for (int b = 0; b < 2; ++b) {
        const D* row = channel + b * taps.below;
        const auto pairs = [&](int first) {
          return reinterpret<T>(
              from_lanes<Pairs>([&](int lane) { return load_lanes<uint64_t>(row + taps.at[i + first + lane]); }));
        };
        const T low = pairs(0), high = pairs(lanes<T> / 2);
        n.v[b][0] = every_second<0>(low, high, all);
        n.v[b][1] = every_second<1>(low, high, all);
      }
      return n;
    }
  }
  using Bits = typename Storage<D>::Bits;
  for (int b = 0; b < 2; ++b) {
    for (int a = 0; a < 2; ++a) {
      const D* neighbour = channel + b * taps.below + a * taps.right;
      n.v[b][a] = Storage<D>::template widen<T>(
          from_lanes<Like<Bits, T>>([&](int lane) { return load_lanes<Bits>(neighbour + taps.at[i + lane]); }));
    }
  }
  return n;
}

// sum of weight[b][a] v[b][a] over the four neighbours of pixels i, i + 1, ...
template <class T>
FISHEYEREC_INLINE T blend(const Neighbours<T>& n, const Scalar<T> (&weight)[2][2][run_length], int i) {
  return load_lanes<T>(weight[0][0] + i) * n.v[0][0] + load_lanes<T>(weight[0][1] + i) * n.v[0][1] +
         (load_lanes<T>(weight[1][0] + i) * n.v[1][0] + load_lanes<T>(weight[1][1] + i) * n.v[1][1]);
}

// Whether reading `width` channels at every neighbour of the run stays within the source, whose last channels a wider
// read would pass.
template <class S>
bool reads_stay_inside(const Image& source, const Taps<S>& taps, int count, int width) {
  if (source.channels >= width) return true;
  const int64_t end_y = source.stride_y > 0 ? (source.height - 1) * source.stride_y : 0;
  const int64_t end_x = source.stride_x > 0 ? (source.width - 1) * source.stride_x : 0;
  const int64_t last = end_y + end_x + source.channels - width;  // the last offset that may be read at
  int64_t furthest = 0;
  for (int i = 0; i < count; ++i) furthest = taps.at[i] > furthest ? taps.at[i] : furthest;
  return furthest + (taps.right > 0 ? taps.right : 0) + (taps.below > 0 ? taps.below : 0) <= last;
}

// target[c][i] = sum of weighted neighbours.
template <class S, class D>
void sample_planar(const Image& source, const D* source_pixels, const Taps<S>& taps, int count, const Image& target,
                   D* target_pixels) {
  using T = Pack<S>;
  const T zero = splat<T>(0);
  for (int64_t c = 0; c < source.channels; ++c) {
    const D* channel = source_pixels + c * source.stride_channel;
    D* out = target_pixels + c * target.stride_channel;
    for (int i = 0; i < count; i += lanes<T>) {
      const Mask<T> live = load_lanes<Index<T>>(taps.live + i) != splat<Index<T>>(0);
      const T value = select(live, blend(gather<T>(channel, taps, i), taps.weight, i), zero);
      store_pixels(out + i, value, count - i);
    }
  }
}

// Channels in steps of T; the last step may read beyond the pixel, never beyond the source, and writes none of that.
template <class T, class D>
void sample_interleaved(const Image& source, const D* source_pixels, const Taps<Scalar<T>>& taps, int count,
                        const Image& target, D* target_pixels) {
  for (int i = 0; i < count; ++i) {
    const D* at = source_pixels + taps.at[i];
    D* out = target_pixels + i * target.stride_x;
    for (int64_t c = 0; c < source.channels; c += lanes<T>) {
      T value = splat<T>(0);
      if (taps.live[i]) {
        for (int b = 0; b < 2; ++b) {
          for (int a = 0; a < 2; ++a) {
            value += taps.weight[b][a][i] * load_pixels<T>(at + b * taps.below + a * taps.right + c);
          }
        }
      }
      store_pixels(out + c, value, source.channels - c);
    }
  }
}

template <class S, class D>
void sample_run(const Image& source, const D* source_pixels, const Taps<S>& taps, int count, const Image& target,
                D* target_pixels) {
  if (!target.interleaved()) return sample_planar(source, source_pixels, taps, count, target, target_pixels);
  const auto interleaved = [&](auto step) {
    sample_interleaved<decltype(step)>(source, source_pixels, taps, count, target, target_pixels);
  };
  if (source.channels % lanes<Pack<S>> == 0) return interleaved(Pack<S>{});
  if (source.channels % few_channels == 0 ||
      (source.channels < few_channels && reads_stay_inside(source, taps, count, few_channels))) {
    return interleaved(FewChannels<S>{});
  }
  interleaved(S{});
}

// grad_x[i] = sum over channels of grad_target[c][i] dtarget[c][i]/dx[i]  (Eq. 7 of FishEyeRecNet), likewise grad_y.
// Written in whole packs, with zeros where nothing is read and beyond count.
template <class S, class D>
void sample_run_adjoint_coordinates(const Image& source, const D* source_pixels, const Taps<S>& taps, int count,
                                    const Image& grad_target, const D* grad_pixels, S* grad_x, S* grad_y) {
  using T = Pack<S>;
  alignas(64) S product[2][2][run_length];  // sum over channels of gradient times neighbour
  if (grad_target.interleaved()) {
    for (int i = 0; i < count; ++i) {
      const D* at = source_pixels + taps.at[i];
      const D* g = grad_pixels + i * grad_target.stride_x;
      const auto sum_channels = [&](auto step, int64_t begin, int64_t end, S(&sums)[2][2]) {
        using V = decltype(step);
        V totals[2][2] = {};
        for (int64_t c = begin; c < end; c += lanes<V>) {
          const V gradient = load_pixels<V>(g + c);
          for (int b = 0; b < 2; ++b) {
            for (int a = 0; a < 2; ++a) {
              totals[b][a] += gradient * load_pixels<V>(at + b * taps.below + a * taps.right + c);
            }
          }
        }
        for (int b = 0; b < 2; ++b) {
          for (int a = 0; a < 2; ++a) {
            S values[lanes<V>];
            store_lanes(values, totals[b][a]);
            for (const S value : values) sums[b][a] += value;
          }
        }
      };
      S sums[2][2] = {};
      const int64_t whole = source.channels / lanes<T> * lanes<T>;
      if (whole) sum_channels(T{}, 0, whole, sums);
      sum_channels(S{}, whole, source.channels, sums);
      for (int b = 0; b < 2; ++b) {
        for (int a = 0; a < 2; ++a) product[b][a][i] = sums[b][a];
      }
    }
  } else {
    for (int64_t c = 0; c < source.channels; ++c) {
      const D* channel = source_pixels + c * source.stride_channel;
      const D* g = grad_pixels + c * grad_target.stride_channel;
      for (int i = 0; i < count; i += lanes<T>) {
        const T gradient = load_first_pixels<T>(g + i, count - i);
        const Neighbours<T> n = gather<T>(channel, taps, i);
        for (int b = 0; b < 2; ++b) {
          for (int a = 0; a < 2; ++a) {
            S* sum = product[b][a] + i;
            const T term = gradient * n.v[b][a];
            store_lanes(sum, c ? load_lanes<T>(sum) + term : term);
          }
        }
      }
    }
  }
  const T zero = splat<T>(0);
  for (int i = 0; i < count; i += lanes<T>) {
    const Mask<T> live = (load_lanes<Index<T>>(taps.live + i) != splat<Index<T>>(0)) &
                         (count_from<Index<T>>(i) < splat<Index<T>>(count));
    const auto total = [&](const S(&slope)[2][2][run_length]) {
      T sum = zero;
      for (int b = 0; b < 2; ++b) {
        for (int a = 0; a < 2; ++a) sum += load_lanes<T>(slope[b][a] + i) * load_lanes<T>(product[b][a] + i);
      }
      return select(live, sum, zero);
    };
    store_lanes(grad_x + i, total(taps.slope_x));
    store_lanes(grad_y + i, total(taps.slope_y));
  }
}

// grad_source += weights * grad_target (Eq. 5 of FishEyeRecNet), only into rows [row_begin, row_end).
template <class S, class D>
void sample_run_adjoint_image(const Image& grad_source, S* grad_source_pixels, const Taps<S>& taps, int count,
                              const Image& grad_target, const D* grad_pixels, int row_begin, int row_end) {
  for (int b = 0; b < 2; ++b) {
    const int first = row_begin - b, end = row_end - b;
    if (b == 1 && taps.below == 0) break;
    if (grad_target.interleaved()) {
      for (int i = 0; i < count; ++i) {
        if (!taps.live[i] || taps.row[i] < first || taps.row[i] >= end) continue;
        const D* g = grad_pixels + i * grad_target.stride_x;
        S* out = grad_source_pixels + taps.at[i] + b * taps.below;
        for (int a = 0; a < 2; ++a, out += taps.right) {
          const S weight = taps.weight[b][a][i];
          if (weight == 0) continue;
          const int64_t channels = grad_source.channels;
          using T = Pack<S>;
          int64_t c = 0;
          for (; c + lanes<T> <= channels; c += lanes<T>) {
            store_lanes(out + c, load_lanes<T>(out + c) + weight * load_pixels<T>(g + c));
          }
          for (; c < channels; ++c) out[c] += weight * load_pixels<S>(g + c);
        }
      }
    } else {
      for (int64_t c = 0; c < grad_source.channels; ++c) {
        S* channel = grad_source_pixels + c * grad_source.stride_channel + b * taps.below;
        const D* g = grad_pixels + c * grad_target.stride_channel;
        for (int i = 0; i < count; ++i) {
          if (!taps.live[i] || taps.row[i] < first || taps.row[i] >= end) continue;
          const S gradient = load_pixels<S>(g + i);
          S* out = channel + taps.at[i];
          out[0] += taps.weight[b][0][i] * gradient;
          out[taps.right] += taps.weight[b][1][i] * gradient;
        }
      }
    }
  }
}

// target[c][i] = the one neighbour with weight. D only carries bytes, so that any type of label survives.
template <class S, class D>
void copy_run(const Image& source, const D* source_pixels, const Taps<S>& taps, int count, const Image& target,
              D* target_pixels) {
  int64_t at[run_length];
  for (int i = 0; i < count; ++i) {
    const int64_t right = taps.weight[0][1][i] + taps.weight[1][1][i] > 0 ? taps.right : 0;
    const int64_t below = taps.weight[1][0][i] + taps.weight[1][1][i] > 0 ? taps.below : 0;
    at[i] = taps.at[i] + right + below;
  }
  const auto copy = [&](int64_t c, int i) {
    const D value = source_pixels[c * source.stride_channel + at[i]];
    target_pixels[c * target.stride_channel + i * target.stride_x] = taps.live[i] ? value : D{};
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
