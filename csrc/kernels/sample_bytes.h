// Bilinear pictures of 8 bits, up to 4 channels side by side, in whole numbers.
//
// Weights are multiples of 2^-15 that add up to what the real ones do, so that a flat picture stays flat. Each is off
// by half of that at most and one by three halves, which makes up for the others: 255 * 1.5 / 2^15 = 0.012 grey levels
// at most before the sum is rounded half up. They are stored negative, as 1 is then -2^15 and fits 16 bits.
#pragma once

#include "sample.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

constexpr int byte_weight_bits = 15;

// Where a run of coordinates reads an image of bytes.
struct ByteTaps {
  alignas(64) int64_t at[run_length];          // offset of the upper left neighbour from the image's first pixel
  alignas(64) int32_t weights[2][run_length];  // [y]: the left neighbour's in the lower 16 bits, the right one's above
};

// sum: of the four weights. Rounding is such that weights add up to it.
FISHEYEREC_INLINE void store_byte_weights(Pack<float> sum, Pack<float> upper_right, Pack<float> lower_left,
                                          Pack<float> lower_right, ByteTaps& taps, int i) {
  using T = Pack<float>;
  constexpr float one = 1 << byte_weight_bits;
  const auto negative = [](T weight) { return truncate(weight * -one - 0.5f); };
  const Index<T> w01 = negative(upper_right), w10 = negative(lower_left), w11 = negative(lower_right);
  const Index<T> w00 = negative(sum) - w01 - w10 - w11;
  store_lanes(taps.weights[0] + i, (w00 & 0xffff) | (w01 << 16));
  store_lanes(taps.weights[1] + i, (w10 & 0xffff) | (w11 << 16));
}

// For a run whose neighbours all lie inside the image: what take_taps() would give, in a quarter of the instructions.
FISHEYEREC_NOINLINE inline void take_interior_byte_taps(const Image& source, int count, const float* x, const float* y,
                                                        ByteTaps& taps) {
  using T = Pack<float>;
  const Index<T> stride_x = splat<Index<T>>(source.stride_x), stride_y = splat<Index<T>>(source.stride_y);
  const T one = splat<T>(1);
  for (int i = 0; i < count; i += lanes<T>) {
    const Tap<T> h = linear_tap_interior(load_lanes<T>(x + i)), v = linear_tap_interior(load_lanes<T>(y + i));
    store_lanes(taps.at + i, convert<Like<int64_t, T>>(v.index * stride_y + h.index * stride_x));
    const T lower_right = h.weight[1] * v.weight[1];
    store_byte_weights(one, h.weight[1] - lower_right, v.weight[1] - lower_right, lower_right, taps, i);
  }
}

FISHEYEREC_NOINLINE inline void take_byte_taps(const Taps<float>& taps, int count, ByteTaps& byte_taps) {
  using T = Pack<float>;
  std::memcpy(byte_taps.at, taps.at, sizeof byte_taps.at);
  for (int i = 0; i < count; i += lanes<T>) {
    const Mask<T> live = load_lanes<Index<T>>(taps.live + i) != splat<Index<T>>(0);
    const auto weight = [&](int b, int a) { return select(live, load_lanes<T>(taps.weight[b][a] + i), splat<T>(0)); };
    const T sum = (weight(0, 0) + weight(0, 1)) + (weight(1, 0) + weight(1, 1));
    store_byte_weights(sum, weight(0, 1), weight(1, 0), weight(1, 1), byte_taps, i);
  }
}

// One value of pixel i. Every layout gives the same bits.
FISHEYEREC_INLINE uint8_t blend_bytes(const ByteTaps& taps, int i, const uint8_t* source, int64_t right,
                                      int64_t below) {
  const uint8_t* upper = source + taps.at[i];
  const auto weighted = [right](int32_t pair, const uint8_t* left) {
    return static_cast<int16_t>(pair & 0xffff) * left[0] + (pair >> 16) * left[right];
  };
  const int32_t sum = weighted(taps.weights[0][i], upper) + weighted(taps.weights[1][i], upper + below);
  return static_cast<uint8_t>(((1 << (byte_weight_bits - 1)) - sum) >> byte_weight_bits);
}

#if defined(__x86_64__) && FISHEYEREC_VECTOR_BYTES >= 32
using Bytes = VectorOf<char, 32>::type;
using Shorts = VectorOf<int16_t, 16>::type;
using Integers = VectorOf<int32_t, 8>::type;

// Eight pixels at a time. Each half of a vector holds the two neighbours of one pixel in one row, as 16 bit pairs of
// (left, right) for each channel: multiplied by the pairs of weights and added, they are the channels' 32 bit sums.
template <int channels>
struct ByteBlock {
  static constexpr int size = 8;

  // Bytes (left, 0, right, 0) of each channel; the upper row's 8 bytes are followed by the lower row's.
  static FISHEYEREC_INLINE Bytes pairs(const Bytes& rows, int row) {
    return __builtin_ia32_pshufb256(
        rows, from_lanes<Bytes>([row](int byte) {
          const int neighbour = byte / 2 % 2, channel = byte % 16 / 4;
          const bool is_pixel = byte % 2 == 0 && channel < channels;
          return static_cast<char>(is_pixel ? 8 * row + neighbour * channels + channel : 0x80);
        }));
  }

  // The channels of pixel j in the lower half, of pixel j + 4 in the upper half: packing puts them in order.
  template <int j>
  static FISHEYEREC_INLINE Integers value(const uint8_t* source, const int64_t* at, int64_t below,
                                          const Integers (&weights)[2]) {
    using Quads = VectorOf<uint64_t, 4>::type;
    const auto eight = [&](int i, int64_t offset) { return load_lanes<uint64_t>(source + at[i] + offset); };
    const Bytes rows = reinterpret<Bytes>(Quads{eight(j, 0), eight(j, below), eight(j + 4, 0), eight(j + 4, below)});
    const auto weighted = [&](int row) {
      const Integers spread = __builtin_ia32_pshufd256(weights[row], 0x55 * j);
      return __builtin_ia32_pmaddwd256(reinterpret<Shorts>(pairs(rows, row)), reinterpret<Shorts>(spread));
    };
    return ((1 << (byte_weight_bits - 1)) - (weighted(0) + weighted(1))) >> byte_weight_bits;
  }

  static FISHEYEREC_INLINE void sample(const uint8_t* source, const int64_t* at, int64_t below,
                                       const int32_t* upper_weights, const int32_t* lower_weights, uint8_t* target) {
    const Integers weights[2] = {load_lanes<Integers>(upper_weights), load_lanes<Integers>(lower_weights)};
    const Shorts first =
        __builtin_ia32_packssdw256(value<0>(source, at, below, weights), value<1>(source, at, below, weights));
    const Shorts second =
        __builtin_ia32_packssdw256(value<2>(source, at, below, weights), value<3>(source, at, below, weights));
    const Bytes packed = reinterpret<Bytes>(__builtin_ia32_packuswb256(first, second));  // four bytes a pixel
    const Bytes dense =
        __builtin_ia32_pshufb256(packed, from_lanes<Bytes>([](int byte) {
                                   const int i = byte % 16;
                                   return static_cast<char>(i < 4 * channels ? i / channels * 4 + i % channels : 0x80);
                                 }));
    char bytes[sizeof dense];
    store_lanes(bytes, dense);
    std::memcpy(target, bytes, 4 * channels);
    std::memcpy(target + 4 * channels, bytes + 16, 4 * channels);
  }
};

// Reads 8 bytes at each left neighbour.
template <int channels>
FISHEYEREC_NOINLINE void sample_blocks(const uint8_t* source, const ByteTaps& taps, int64_t below, int count,
                                       uint8_t* target) {
  using Block = ByteBlock<channels>;
  const auto sample = [&](const int64_t* at, int i, uint8_t* to) {
    Block::sample(source, at, below, taps.weights[0] + i, taps.weights[1] + i, to);
  };
  int i = 0;
  for (; i + Block::size <= count; i += Block::size) sample(taps.at + i, i, target + i * channels);
  if (i == count) return;
  int64_t at[Block::size];
  for (int j = 0; j < Block::size; ++j) at[j] = taps.at[i + j < count ? i + j : i];
  uint8_t rest[Block::size * channels];
  sample(at, i, rest);
  std::memcpy(target + i * channels, rest, static_cast<size_t>((count - i) * channels));
}

constexpr bool has_byte_blocks = true;
#else
constexpr bool has_byte_blocks = false;

template <int channels>
void sample_blocks(const uint8_t*, const ByteTaps&, int64_t, int, uint8_t*) {}
#endif

// target[c][i] = the weighted neighbours, right and below of the upper left one.
inline void sample_run(const Image& source, const uint8_t* source_pixels, const ByteTaps& taps, int64_t right,
                       int64_t below, int count, const Image& target, uint8_t* target_pixels) {
  const int64_t channels = interleaved(source, target) ? source.channels : 1;  // side by side
  const bool in_blocks = has_byte_blocks && channels <= 4 && right == channels && target.stride_x == channels &&
                         reads_stay_inside(source, taps.at, count, below, channels, 8);
  for (int64_t c = 0; c < source.channels; c += channels) {
    const uint8_t* from = source_pixels + c * source.stride_channel;
    uint8_t* to = target_pixels + c * target.stride_channel;
    prefetch_below(source, from, taps.at, count);
    switch (in_blocks ? channels : 0) {
      case 1: sample_blocks<1>(from, taps, below, count, to); break;
      case 2: sample_blocks<2>(from, taps, below, count, to); break;
      case 3: sample_blocks<3>(from, taps, below, count, to); break;
      case 4: sample_blocks<4>(from, taps, below, count, to); break;
      default:
        for (int i = 0; i < count; ++i) {
          for (int64_t k = 0; k < channels; ++k) {
            to[i * target.stride_x + k] = blend_bytes(taps, i, from + k, right, below);
          }
        }
    }
  }
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
