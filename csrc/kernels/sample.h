// Reading (and, in the adjoint, writing) the source image at a run of taps.
//
// Two layouts. Planar: channels lie apart, vectors run over the pixels of the run, which read from all over the
// image. Interleaved: channels lie side by side, vectors run over the channels of one pixel.
#pragma once

#include "rows_table.h"
#include "taps.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

inline bool interleaved(const Image& source, const Image& target) {
  return source.interleaved() && target.interleaved();
}

// Few channels are handled four at a time, many in full vectors.
constexpr int few_channels = 4;
template <class S>
using FewChannels = std::conditional_t<sizeof(S) == 8, double, typename VectorOf<float, few_channels>::type>;

// The four neighbours of the pixels i, i + 1, ... of a run in one channel.
template <class T>
struct Neighbours {
  T v[2][2];  // [y][x]
};

// adjacent: the right neighbour is the next element, so that 64 bits hold both.
template <class T, bool adjacent, class D>
FISHEYEREC_INLINE Neighbours<T> gather(const D* channel, const Taps<Scalar<T>>& taps, int i) {
  Neighbours<T> n;
  const int64_t* at = taps.at + i;
  for (int b = 0; b < 2; ++b) {
    const D* row = channel + b * taps.below;
    if constexpr (adjacent) {
      gather_pairs([&](int lane) { return row + at[lane]; }, n.v[b][0], n.v[b][1]);
    } else {
      using Bits = typename Storage<D>::Bits;
      for (int a = 0; a < 2; ++a) {
        const D* neighbour = row + a * taps.right;
        n.v[b][a] = Storage<D>::template widen<T>(
            from_lanes<Like<Bits, T>>([&](int lane) { return load_lanes<Bits>(neighbour + at[lane]); }));
      }
    }
  }
  return n;
}

// Calls visit(std::true_type) where gather() can take adjacent neighbours together.
template <class T, class D, class Visit>
FISHEYEREC_INLINE void with_adjacency(const Taps<Scalar<T>>& taps, const Visit& visit) {
  if constexpr (is_vector<T> && std::is_same_v<D, float>) {
    if (taps.right == 1) return visit(std::true_type{});
  }
  visit(std::false_type{});
}

// The sum of weight[b][a] v[b][a]. In one place, so that every layout rounds alike.
template <class T>
FISHEYEREC_INLINE T blend(const Neighbours<T>& n, T w00, T w01, T w10, T w11) {
  const T upper_left = w00 * n.v[0][0], lower_left = w10 * n.v[1][0];
  const T upper = w01 * n.v[0][1] + upper_left;
  const T lower = w11 * n.v[1][1] + lower_left;
  return upper + lower;
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

// Asks for the source rows that the runs a few target rows below will read. The hardware cannot guess them, as each
// run reads short pieces of many rows.
template <class S, class D>
FISHEYEREC_INLINE void prefetch_below(const Image& source, const D* channel, const Taps<S>& taps, int count) {
  constexpr int rows = 4;
  constexpr int64_t line = 64 / sizeof(D);
  const int64_t pixel = source.stride_x < 0 ? -source.stride_x : source.stride_x;
  const int step = static_cast<int>(pixel > 0 && pixel < line ? line / pixel : 1);
  for (int i = 0; i < count; i += step) __builtin_prefetch(channel + taps.at[i] + rows * source.stride_y);
}

// target[c][i] = sum of weighted neighbours.
template <class S, class D>
FISHEYEREC_NOINLINE void sample_planar(const Image& source, const D* source_pixels, const Taps<S>& taps, int count,
                                       const Image& target, D* target_pixels) {
  using T = Pack<S>;
  with_adjacency<T, D>(taps, [&](auto adjacent) {
    for (int64_t c = 0; c < source.channels; ++c) {
      const D* channel = source_pixels + c * source.stride_channel;
      D* out = target_pixels + c * target.stride_channel;
      prefetch_below(source, channel, taps, count);
      const auto value = [&](int i) {
        const Mask<T> live = load_lanes<Index<T>>(taps.live + i) != splat<Index<T>>(0);
        const auto weight = [&](int b, int a) { return load_lanes<T>(taps.weight[b][a] + i); };
        const T sum =
            blend(gather<T, adjacent.value>(channel, taps, i), weight(0, 0), weight(0, 1), weight(1, 0), weight(1, 1));
        return select(live, sum, splat<T>(0));
      };
      int i = 0;
      for (; i + lanes<T> <= count; i += lanes<T>) store_pixels(out + i, value(i));
      if (i < count) store_first_pixels(out + i, value(i), count - i);
    }
  });
}

// The weighted sum of the neighbours of pixel i in the channels that begin at `at`.
template <class T, class D>
FISHEYEREC_INLINE T blend_channels(const D* at, const Taps<Scalar<T>>& taps, int i) {
  const auto weight = [&](int b, int a) { return splat<T>(taps.weight[b][a][i]); };
  const D* below = at + taps.below;
  const Neighbours<T> n{{{load_pixels<T>(at), load_pixels<T>(at + taps.right)},
                         {load_pixels<T>(below), load_pixels<T>(below + taps.right)}}};
  const T sum = blend(n, weight(0, 0), weight(0, 1), weight(1, 0), weight(1, 1));
  // Weights are 0 where nothing is read, but 0 times infinity is not.
  return select(splat<Mask<T>>(taps.live[i]) != splat<Mask<T>>(0), sum, splat<T>(0));
}

// Channels in steps of T, which divide their number.
template <class T, class D>
FISHEYEREC_NOINLINE void sample_many_channels(const Image& source, const D* source_pixels, const Taps<Scalar<T>>& taps,
                                              int count, const Image& target, D* target_pixels) {
  for (int i = 0; i < count; ++i) {
    const D* at = source_pixels + taps.at[i];
    D* out = target_pixels + i * target.stride_x;
    for (int64_t c = 0; c < source.channels; c += lanes<T>) store_pixels(out + c, blend_channels<T>(at + c, taps, i));
  }
}

// All channels, at most lanes<T>, in one step that reads beyond the pixel (reads_stay_inside) and, but for the last,
// writes into the next pixel, which is written after it.
template <class T, class D>
FISHEYEREC_NOINLINE void sample_few_channels(const Image& source, const D* source_pixels, const Taps<Scalar<T>>& taps,
                                             int count, D* target_pixels) {
  const int64_t channels = source.channels;
  prefetch_below(source, source_pixels, taps, count);
  for (int i = 0; i + 1 < count; ++i) {
    store_pixels(target_pixels + i * channels, blend_channels<T>(source_pixels + taps.at[i], taps, i));
  }
  const int last = count - 1;
  store_first_pixels(target_pixels + last * channels, blend_channels<T>(source_pixels + taps.at[last], taps, last),
                     channels);
}

template <class S, class D>
void sample_run(const Image& source, const D* source_pixels, const Taps<S>& taps, int count, const Image& target,
                D* target_pixels) {
  using Few = FewChannels<S>;
  if (!interleaved(source, target)) {
    sample_planar(source, source_pixels, taps, count, target, target_pixels);
  } else if (source.channels % lanes<Pack<S>> == 0) {
    sample_many_channels<Pack<S>>(source, source_pixels, taps, count, target, target_pixels);
  } else if (source.channels <= lanes<Few> && target.stride_x == source.channels &&
             reads_stay_inside(source, taps, count, lanes<Few>)) {
    sample_few_channels<Few>(source, source_pixels, taps, count, target_pixels);
  } else {
    sample_many_channels<S>(source, source_pixels, taps, count, target, target_pixels);
  }
}

// grad_x[i] = sum over channels of grad_target[c][i] dtarget[c][i]/dx[i]  (Eq. 7 of FishEyeRecNet), likewise grad_y.
// Written in whole packs, with zeros where nothing is read and beyond count.
template <class S, class D>
FISHEYEREC_NOINLINE void sample_run_adjoint_coordinates(const Image& source, const D* source_pixels,
                                                        const Taps<S>& taps, int count, const Image& grad_target,
                                                        const D* grad_pixels, S* grad_x, S* grad_y) {
  using T = Pack<S>;
  alignas(64) S product[2][2][run_length] = {};  // sum over channels of gradient times neighbour
  if (interleaved(source, grad_target)) {
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
    with_adjacency<T, D>(taps, [&](auto adjacent) {
      for (int64_t c = 0; c < source.channels; ++c) {
        const D* channel = source_pixels + c * source.stride_channel;
        const D* g = grad_pixels + c * grad_target.stride_channel;
        prefetch_below(source, channel, taps, count);
        for (int i = 0; i < count; i += lanes<T>) {
          const T gradient = load_first_pixels<T>(g + i, count - i);
          const Neighbours<T> n = gather<T, adjacent.value>(channel, taps, i);
          for (int b = 0; b < 2; ++b) {
            for (int a = 0; a < 2; ++a) {
              S* sum = product[b][a] + i;
              store_lanes(sum, load_lanes<T>(sum) + gradient * n.v[b][a]);
            }
          }
        }
      }
    });
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

// grad_source += weights * grad_target (Eq. 5 of FishEyeRecNet), only into the rows of `band`, in the run's order.
template <class S, class D>
FISHEYEREC_NOINLINE void sample_run_adjoint_image(const Image& grad_source, S* grad_source_pixels, const Taps<S>& taps,
                                                  int count, const Image& grad_target, const D* grad_pixels,
                                                  const RowRange& band) {
  using T = Pack<S>;
  // Pixels whose upper (b = 0) or lower (b = 1) neighbours lie in the band.
  int32_t selected[2][run_length], selected_count[2] = {0, 0};
  for (int b = 0; b < (taps.two_rows ? 2 : 1); ++b) {
    for (int i = 0; i < count; ++i) {
      const int32_t row = taps.row[i] + b;
      selected[b][selected_count[b]] = i;
      selected_count[b] += (taps.live[i] != 0) & (row >= band.first) & (row <= band.last);
    }
  }
  for (int b = 0; b < 2; ++b) {
    if (interleaved(grad_source, grad_target)) {
      for (int j = 0; j < selected_count[b]; ++j) {
        const int i = selected[b][j];
        const D* g = grad_pixels + i * grad_target.stride_x;
        S* out = grad_source_pixels + taps.at[i] + b * taps.below;
        for (int a = 0; a < 2; ++a, out += taps.right) {
          const S weight = taps.weight[b][a][i];
          int64_t c = 0;
          for (; c + lanes<T> <= grad_source.channels; c += lanes<T>) {
            store_lanes(out + c, load_lanes<T>(out + c) + weight * load_pixels<T>(g + c));
          }
          for (; c < grad_source.channels; ++c) out[c] += weight * load_pixels<S>(g + c);
        }
      }
    } else {
      alignas(64) S term[2][run_length];
      for (int64_t c = 0; c < grad_source.channels; ++c) {
        S* channel = grad_source_pixels + c * grad_source.stride_channel + b * taps.below;
        const D* g = grad_pixels + c * grad_target.stride_channel;
        prefetch_below(grad_source, channel, taps, count);
        for (int i = 0; i < count; i += lanes<T>) {
          const T gradient = load_first_pixels<T>(g + i, count - i);
          for (int a = 0; a < 2; ++a) store_lanes(term[a] + i, load_lanes<T>(taps.weight[b][a] + i) * gradient);
        }
        const int64_t right = taps.right;
        const auto add = [&](int i) {
          S* out = channel + taps.at[i];
          const S left_value = out[0] + term[0][i];
          out[0] = left_value;
          out[right] += term[1][i];
        };
        if (selected_count[b] == count) {
          for (int i = 0; i < count; ++i) add(i);
        } else {
          for (int j = 0; j < selected_count[b]; ++j) add(selected[b][j]);
        }
      }
    }
  }
}

// target[c][i] = the nearest pixel. D only carries bytes, so that any type of label survives.
template <class S, class D>
FISHEYEREC_NOINLINE void copy_run(const Image& source, const D* source_pixels, const Taps<S>& taps, int count,
                                  const Image& target, D* target_pixels) {
  const auto copy = [&](int64_t c, int i) {
    const D value = source_pixels[c * source.stride_channel + taps.at[i]];
    target_pixels[c * target.stride_channel + i * target.stride_x] = taps.live[i] ? value : D{};
  };
  if (interleaved(source, target)) {
    for (int i = 0; i < count; ++i) {
      for (int64_t c = 0; c < source.channels; ++c) copy(c, i);
    }
  } else {
    for (int64_t c = 0; c < source.channels; ++c) {
      prefetch_below(source, source_pixels + c * source.stride_channel, taps, count);
      for (int i = 0; i < count; ++i) copy(c, i);
    }
  }
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
