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

// Whether reading `width` values at every offset, and `below` further, stays within the source, whose pixels hold
// `channels` values side by side: a wider read may pass the last one.
inline bool reads_stay_inside(const Image& source, const int64_t* at, int count, int64_t below, int64_t channels,
                              int64_t width) {
  const int64_t end_y = source.stride_y > 0 ? (source.height - 1) * source.stride_y : 0;
  const int64_t end_x = source.stride_x > 0 ? (source.width - 1) * source.stride_x : 0;
  const int64_t last = end_y + end_x + channels - width - (below > 0 ? below : 0);  // may be read at
  int64_t furthest = 0;
  for (int i = 0; i < count; ++i) furthest = at[i] > furthest ? at[i] : furthest;
  return furthest <= last;
}

// Asks for the source rows that the runs a few target rows below will read. The hardware cannot guess them, as each
// run reads short pieces of many rows.
template <class D>
FISHEYEREC_INLINE void prefetch_below(const Image& source, const D* channel, const int64_t* at, int count) {
  constexpr int rows = 4;
  constexpr int64_t line = 64 / sizeof(D);
  const int64_t pixel = source.stride_x < 0 ? -source.stride_x : source.stride_x;
  const int step = static_cast<int>(pixel > 0 && pixel < line ? line / pixel : 1);
  for (int i = 0; i < count; i += step) __builtin_prefetch(channel + at[i] + rows * source.stride_y);
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
      prefetch_below(source, channel, taps.at, count);
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
  prefetch_below(source, source_pixels, taps.at, count);
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
             reads_stay_inside(source, taps.at, count, taps.below, source.channels,
                               (taps.right > 0 ? taps.right : 0) + lanes<Few>)) {
    sample_few_channels<Few>(source, source_pixels, taps, count, target_pixels);
  } else {
    sample_many_channels<S>(source, source_pixels, taps, count, target, target_pixels);
  }
}

// The sums of four values each: values[0 .. 3], values[4 .. 7], ...
template <class T>
FISHEYEREC_INLINE T sums_of_four(const Scalar<T>* values) {
  constexpr auto all = std::make_integer_sequence<int, lanes<T>>{};
  const auto sums_of_two = [all](const T& a, const T& b) {
    return every_second<0>(a, b, all) + every_second<1>(a, b, all);
  };
  const auto part = [values](int i) { return load_lanes<T>(values + i * lanes<T>); };
  return sums_of_two(sums_of_two(part(0), part(1)), sums_of_two(part(2), part(3)));
}

// The same as below for at most 4 floats side by side, read by fours: beyond the pixel too (reads_stay_inside), as
// is grad_target but for the run's last pixel.
template <class S, class D>
FISHEYEREC_NOINLINE void few_channels_adjoint_coordinates(const Image& source, const D* source_pixels,
                                                          const Taps<S>& taps, int count, const Image& grad_target,
                                                          const D* grad_pixels, S* grad_x, S* grad_y) {
  using T = Pack<S>;
  using V = FewChannels<S>;
  alignas(64) S x_terms[run_length][few_channels], y_terms[run_length][few_channels];
  const Mask<V> of_the_pixel = count_from<Index<V>>(0) < splat<Index<V>>(source.channels);
  prefetch_below(source, source_pixels, taps.at, count);
  for (int i = 0; i < count; ++i) {
    const D* g = grad_pixels + i * grad_target.stride_x;
    const V gradient = i + 1 < count ? load_pixels<V>(g) : load_first_pixels<V>(g, source.channels);
    V dx = splat<V>(0), dy = dx;
    for (int b = 0; b < 2; ++b) {
      for (int a = 0; a < 2; ++a) {
        const V v = load_pixels<V>(source_pixels + taps.at[i] + b * taps.below + a * taps.right);
        dx += taps.slope_x[b][a][i] * v;
        dy += taps.slope_y[b][a][i] * v;
      }
    }
    store_lanes(x_terms[i], select(of_the_pixel, dx * gradient, splat<V>(0)));
    store_lanes(y_terms[i], select(of_the_pixel, dy * gradient, splat<V>(0)));
  }
  for (int i = 0; i < count; i += lanes<T>) {
    const Mask<T> live = (load_lanes<Index<T>>(taps.live + i) != splat<Index<T>>(0)) &
                         (count_from<Index<T>>(i) < splat<Index<T>>(count));
    store_lanes(grad_x + i, select(live, sums_of_four<T>(x_terms[i]), splat<T>(0)));
    store_lanes(grad_y + i, select(live, sums_of_four<T>(y_terms[i]), splat<T>(0)));
  }
}

// grad_x[i] = sum over channels of grad_target[c][i] dtarget[c][i]/dx[i]  (Eq. 7 of FishEyeRecNet), likewise grad_y.
// Written in whole packs, with zeros where nothing is read and beyond count.
template <class S, class D>
FISHEYEREC_NOINLINE void sample_run_adjoint_coordinates(const Image& source, const D* source_pixels,
                                                        const Taps<S>& taps, int count, const Image& grad_target,
                                                        const D* grad_pixels, S* grad_x, S* grad_y) {
  using T = Pack<S>;
  if constexpr (is_vector<FewChannels<S>>) {
    const int64_t wide = (taps.right > 0 ? taps.right : 0) + few_channels;
    if (interleaved(source, grad_target) && source.channels <= few_channels &&
        grad_target.stride_x == source.channels &&
        reads_stay_inside(source, taps.at, count, taps.below, source.channels, wide)) {
      return few_channels_adjoint_coordinates(source, source_pixels, taps, count, grad_target, grad_pixels, grad_x,
                                              grad_y);
    }
  }
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
        prefetch_below(source, channel, taps.at, count);
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

// Which upper (b = 0) and lower (b = 1) neighbours of a run are added to: those that lie in a band of rows.
struct Selection {
  bool all;  // of every pixel, in both rows; `selected` is then not written
  uint8_t selected[2][run_length];

  template <class S>
  Selection(const Taps<S>& taps, int count, const RowRange& range, bool interior, const RowRange& band)
      : all(interior && taps.two_rows && range.first >= band.first && range.last <= band.last) {
    for (int i = 0; i < count && !all; ++i) {
      for (int b = 0; b < 2; ++b) {
        const int32_t row = taps.row[i] + b;
        selected[b][i] = (taps.live[i] != 0) & (row >= band.first) & (row <= band.last) & (b == 0 || taps.two_rows);
      }
    }
  }
};

// out[k] += left_weight * g[k] and out[channels + k] += right_weight * g[k], for neighbours that lie side by side.
template <int channels, class S>
FISHEYEREC_INLINE void add_side_by_side(S* out, S left_weight, S right_weight, const S (&g)[channels]) {
  const auto add = [&](auto step, int begin) {
    using V = decltype(step);
    const V weights = from_lanes<V>([&](int lane) { return begin + lane < channels ? left_weight : right_weight; });
    const V gradients = from_lanes<V>([&](int lane) { return g[(begin + lane) % channels]; });
    store_lanes(out + begin, load_lanes<V>(out + begin) + weights * gradients);
  };
  using Two = typename VectorOf<S, 2>::type;
  using Four = typename VectorOf<S, 4>::type;
  add(Four{}, 0);
  if constexpr (channels == 4) add(Four{}, 4);
  if constexpr (channels == 3) add(Two{}, 4);
}

// grad_source += weights * grad_target in planes of `channels` channels side by side.
//
// Neighbouring pixels add to the same memory. A processor that reads what it has only just written, in other pieces,
// waits; so pixels are taken in an order that comes back to a place after a while.
template <int planes, int channels, class S, class D>
FISHEYEREC_NOINLINE void scatter(const Image& grad_source, S* grad_source_pixels, const Taps<S>& taps, int count,
                                 const Image& grad_target, const D* grad_pixels, const Selection& selection) {
  constexpr int stride = 4;
  const int64_t right = taps.right;
  const auto add = [&](auto side_by_side, int i, bool upper, bool lower) {
    for (int plane = 0; plane < planes; ++plane) {
      S g[channels];
      for (int c = 0; c < channels; ++c) {
        g[c] = load_pixels<S>(grad_pixels + i * grad_target.stride_x + (plane + c) * grad_target.stride_channel);
      }
      for (int b = 0; b < 2; ++b) {
        if (!(b ? lower : upper)) continue;
        S* out = grad_source_pixels + taps.at[i] + b * taps.below + plane * grad_source.stride_channel;
        const S left_weight = taps.weight[b][0][i], right_weight = taps.weight[b][1][i];
        if constexpr (side_by_side.value) {
          add_side_by_side<channels>(out, left_weight, right_weight, g);
        } else {
          for (int c = 0; c < channels; ++c, out += grad_source.stride_channel) {
            out[0] += left_weight * g[c];
            out[right] += right_weight * g[c];
          }
        }
      }
    }
  };
  const auto add_all = [&](auto side_by_side) {
    for (int first = 0; first < stride; ++first) {
      for (int i = first; i < count; i += stride) {
        if (selection.all) {
          add(side_by_side, i, true, true);
        } else {
          add(side_by_side, i, selection.selected[0][i], selection.selected[1][i]);
        }
      }
    }
  };
  if constexpr (channels > 1) {
    if (right == channels) return add_all(std::true_type{});
  }
  add_all(std::false_type{});
}

// The same for many channels side by side, all of one pixel after the other.
template <class S, class D>
FISHEYEREC_NOINLINE void scatter_many_channels(const Image& grad_source, S* grad_source_pixels, const Taps<S>& taps,
                                               int count, const Image& grad_target, const D* grad_pixels,
                                               const Selection& selection) {
  using T = Pack<S>;
  for (int i = 0; i < count; ++i) {
    const D* g = grad_pixels + i * grad_target.stride_x;
    for (int b = 0; b < 2; ++b) {
      if (!selection.all && !selection.selected[b][i]) continue;
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
  }
}

// grad_source += weights * grad_target (Eq. 5 of FishEyeRecNet), only where selected, in an order that depends on the
// run alone.
template <class S, class D>
void sample_run_adjoint_image(const Image& grad_source, S* grad_source_pixels, const Taps<S>& taps, int count,
                              const Image& grad_target, const D* grad_pixels, const Selection& selection) {
  const int64_t channels = grad_source.channels;
  const auto call = [&](const auto& kernel, int64_t c) {
    kernel(grad_source, grad_source_pixels + c * grad_source.stride_channel, taps, count, grad_target,
           grad_pixels + c * grad_target.stride_channel, selection);
  };
  if (interleaved(grad_source, grad_target)) {
    switch (channels) {
      case 2: return call(scatter<1, 2, S, D>, 0);
      case 3: return call(scatter<1, 3, S, D>, 0);
      case 4: return call(scatter<1, 4, S, D>, 0);
      default: return call(scatter_many_channels<S, D>, 0);
    }
  }
  for (int64_t c = 0; c < channels; c += 4) {
    switch (channels - c) {
      case 1: call(scatter<1, 1, S, D>, c); break;
      case 2: call(scatter<2, 1, S, D>, c); break;
      case 3: call(scatter<3, 1, S, D>, c); break;
      default: call(scatter<4, 1, S, D>, c);
    }
  }
}

// Pixels of at least half of `size` bytes, side by side in the target, each copied as if it had `size`: reads beyond
// the pixel (reads_stay_inside) and, but for the last, writes into the next pixel, which is written after it.
template <int size, class S, class D>
FISHEYEREC_NOINLINE void copy_pixels(const D* source_pixels, const Taps<S>& taps, int count, int64_t channels,
                                     D* target_pixels) {
  const auto copy = [&](int i, size_t bytes) {
    char pixel[size] = {};
    if (taps.live[i]) std::memcpy(pixel, source_pixels + taps.at[i], bytes);
    std::memcpy(target_pixels + i * channels, pixel, bytes);
  };
  for (int i = 0; i + 1 < count; ++i) copy(i, size);
  copy(count - 1, static_cast<size_t>(channels) * sizeof(D));
}

// target[c][i] = the nearest pixel. D only carries bytes, so that any type of label survives.
template <class S, class D>
void copy_run(const Image& source, const D* source_pixels, const Taps<S>& taps, int count, const Image& target,
              D* target_pixels) {
  const int64_t channels = interleaved(source, target) ? source.channels : 1;
  const int64_t bytes = channels * static_cast<int64_t>(sizeof(D));
  for (int64_t c = 0; c < source.channels; c += channels) {
    const D* from = source_pixels + c * source.stride_channel;
    D* to = target_pixels + c * target.stride_channel;
    const auto fits = [&](int64_t size) {
      return bytes <= size && size <= 2 * bytes && target.stride_x == channels &&
             reads_stay_inside(source, taps.at, count, 0, channels, size / static_cast<int64_t>(sizeof(D)));
    };
    prefetch_below(source, from, taps.at, count);
    if (bytes == sizeof(D) && target.stride_x == 1) {
      copy_pixels<sizeof(D)>(from, taps, count, channels, to);
    } else if (fits(4)) {
      copy_pixels<4>(from, taps, count, channels, to);
    } else if (fits(8)) {
      copy_pixels<8>(from, taps, count, channels, to);
    } else if (fits(16)) {
      copy_pixels<16>(from, taps, count, channels, to);
    } else {
      for (int i = 0; i < count; ++i) {
        for (int64_t k = 0; k < channels; ++k) to[i * target.stride_x + k] = taps.live[i] ? from[taps.at[i] + k] : D{};
      }
    }
  }
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
