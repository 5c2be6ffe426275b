// Storage types and how vectors of pixels go in and out of memory. float16 and bfloat16 are storage only: every
// computation on them is done in float.
#pragma once

#include "../geometry/lanes.h"

namespace fisheyerec {

struct Float16 {
  uint16_t bits;
};

struct BFloat16 {
  uint16_t bits;
};

// The vector of S with the lanes of T, or the scalar S where T is a scalar.
template <class S, class T>
struct LikeOf {
  using type = typename VectorOf<S, lanes<T>>::type;
};
template <class S>
struct LikeOf<S, float> {
  using type = S;
};
template <class S>
struct LikeOf<S, double> {
  using type = S;
};
template <class S, class T>
using Like = typename LikeOf<S, T>::type;

template <class To, class From>
FISHEYEREC_INLINE To convert(const From& from) {
  if constexpr (is_vector<To>) {
    return __builtin_convertvector(from, To);
  } else {
    return static_cast<To>(from);
  }
}

// Round half to even when the lowest `count` bits are dropped.
template <class U>
FISHEYEREC_INLINE U drop_bits(U bits, int count) {
  const uint32_t half = 1u << (count - 1);
  return (bits + (half - 1) + ((bits >> count) & 1u)) >> count;
}

// How values of storage type D become T (float, double or a vector of floats) and back.
template <class D>
struct Storage {
  using Bits = D;
  template <class T>
  static FISHEYEREC_INLINE T widen(const Like<D, T>& stored) {
    return convert<T>(stored);
  }
  template <class T>
  static FISHEYEREC_INLINE Like<D, T> narrow(const T& value) {
    return convert<Like<D, T>>(value);
  }
};

// Of a weighted mean of whole numbers, which never leaves their range.
template <class D, class T>
FISHEYEREC_INLINE Like<D, T> round_half_up(const T& value) {
  return convert<Like<D, T>>(truncate(value + Scalar<T>(0.5)));
}

template <>
struct Storage<uint8_t> {
  using Bits = uint8_t;
  template <class T>
  static FISHEYEREC_INLINE T widen(const Like<uint8_t, T>& stored) {
    using I = Like<int32_t, T>;
    if constexpr (lanes<T> == 4) {  // four bytes are one number, which compilers otherwise take apart byte by byte
      return convert<T>((splat<I>(reinterpret<int32_t>(stored)) >> I{0, 8, 16, 24}) & 255);
    } else {
      return convert<T>(convert<I>(stored));
    }
  }
  template <class T>
  static FISHEYEREC_INLINE Like<uint8_t, T> narrow(const T& value) {
    return round_half_up<uint8_t>(value);
  }
};

template <>
struct Storage<uint16_t> {
  using Bits = uint16_t;
  template <class T>
  static FISHEYEREC_INLINE T widen(const Like<uint16_t, T>& stored) {
    return convert<T>(convert<Like<int32_t, T>>(stored));
  }
  template <class T>
  static FISHEYEREC_INLINE Like<uint16_t, T> narrow(const T& value) {
    return round_half_up<uint16_t>(value);
  }
};

template <>
struct Storage<BFloat16> {
  using Bits = uint16_t;
  template <class T>
  static FISHEYEREC_INLINE T widen(const Like<uint16_t, T>& stored) {
    return reinterpret<T>(convert<Like<uint32_t, T>>(stored) << 16);
  }
  template <class T>
  static FISHEYEREC_INLINE Like<uint16_t, T> narrow(const T& value) {
    using U = Like<uint32_t, T>;
    const U rounded = drop_bits(reinterpret<U>(value), 16);
    return convert<Like<uint16_t, T>>(select(value == value, rounded, splat<U>(0x7fc0)));
  }
};

template <>
struct Storage<Float16> {
  using Bits = uint16_t;
  template <class T>
  static FISHEYEREC_INLINE T widen(const Like<uint16_t, T>& stored) {
    using U = Like<uint32_t, T>;
    const U bits = convert<U>(stored);
    const U sign = (bits & 0x8000u) << 16, magnitude = (bits & 0x7fffu) << 13;
    // The exponent biases are 15 and 127: 2^112 corrects subnormals as well. Infinity and NaN keep a full exponent.
    const U scaled = reinterpret<U>(reinterpret<T>(magnitude) * 0x1p112f);
    return reinterpret<T>(sign | select(magnitude >= splat<U>(0x0f800000), magnitude | 0x7f800000u, scaled));
  }
  template <class T>
  static FISHEYEREC_INLINE Like<uint16_t, T> narrow(const T& value) {
    using U = Like<uint32_t, T>;
    const U bits = reinterpret<U>(value);
    const U magnitude = bits & 0x7fffffffu;
    // Subnormal halves are multiples of 2^-24, which is the last bit of 1/2: adding 1/2 rounds to them.
    const U subnormal = reinterpret<U>(reinterpret<T>(magnitude) + 0x1p-1f) - 0x3f000000u;
    const U normal = drop_bits(magnitude - 0x38000000u, 13);  // the exponent biases are 127 and 15
    const U rounded = select(magnitude < splat<U>(0x38800000), subnormal, normal);
    const U infinity = splat<U>(0x7c00);
    const U finite = select(rounded < infinity, rounded, infinity);
    const U half = select(value == value, finite, splat<U>(0x7e00));
    return convert<Like<uint16_t, T>>(((bits >> 16) & 0x8000u) | half);
  }
};

// The lanes of T from consecutive pixels in memory.
template <class T, class D>
FISHEYEREC_INLINE T load_pixels(const D* memory) {
  return Storage<D>::template widen<T>(load_lanes<Like<typename Storage<D>::Bits, T>>(memory));
}

template <class T, class D>
FISHEYEREC_INLINE void store_pixels(D* memory, const T& values) {
  store_lanes(memory, Storage<D>::template narrow<T>(values));
}

// Writes the first `count` lanes only.
template <class T, class D>
FISHEYEREC_INLINE void store_first_pixels(D* memory, const T& values, int64_t count) {
  const auto stored = Storage<D>::template narrow<T>(values);
  if constexpr (is_vector<T>) {
    for (int lane = 0; lane < lanes<T> && lane < count; ++lane) {
      const auto value = stored[lane];
      store_lanes(memory + lane, value);
    }
  } else {
    store_lanes(memory, stored);
  }
}

// Reads from memory that ends after `count` >= 1 pixels; further lanes are 0.
template <class T, class D>
FISHEYEREC_INLINE T load_first_pixels(const D* memory, int64_t count) {
  if (lanes<T> == 1 || count >= lanes<T>) return load_pixels<T>(memory);
  using Bits = typename Storage<D>::Bits;
  Like<Bits, T> stored{};
  if constexpr (is_vector<T>) {
    for (int lane = 0; lane < count; ++lane) stored[lane] = load_lanes<Bits>(memory + lane);
  }
  return Storage<D>::template widen<T>(stored);
}

}  // namespace fisheyerec
