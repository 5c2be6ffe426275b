// float16 and bfloat16 as storage: every computation is done in float.
#pragma once

#include <cstdint>
#include <cstring>

#include "../geometry/pixel.h"

namespace fisheyerec {

struct Float16 {
  uint16_t bits;
};

struct BFloat16 {
  uint16_t bits;
};

FISHEYEREC_INLINE float float_from_bits(uint32_t bits) {
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

FISHEYEREC_INLINE uint32_t bits_from_float(float value) {
  uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return bits;
}

// Round half to even when the lowest `count` bits are dropped.
FISHEYEREC_INLINE uint32_t drop_bits(uint32_t bits, int count) {
  const uint32_t half = 1u << (count - 1);
  return (bits + (half - 1) + ((bits >> count) & 1)) >> count;
}

template <class T, class D>
FISHEYEREC_INLINE T load(D stored) {
  return static_cast<T>(stored);
}

template <class T>
FISHEYEREC_INLINE T load(BFloat16 stored) {
  return float_from_bits(static_cast<uint32_t>(stored.bits) << 16);
}

template <class T>
FISHEYEREC_INLINE T load(Float16 stored) {
  const uint32_t sign = static_cast<uint32_t>(stored.bits & 0x8000) << 16;
  const uint32_t magnitude = static_cast<uint32_t>(stored.bits & 0x7fff) << 13;
  // The exponent biases are 15 and 127: 2^112 corrects subnormals as well. Infinity and NaN keep a full exponent.
  const float scaled = float_from_bits(magnitude) * 0x1p112f;
  const uint32_t special = magnitude | 0x7f800000u;
  return float_from_bits(sign | (magnitude >= 0x0f800000u ? special : bits_from_float(scaled)));
}

template <class D, class T>
struct Store {
  static FISHEYEREC_INLINE D from(T value) { return static_cast<D>(value); }
};

template <class T>
struct Store<uint8_t, T> {
  static FISHEYEREC_INLINE uint8_t from(T value) {  // round half up: a weighted mean never leaves [0, 255]
    return static_cast<uint8_t>(static_cast<int>(value + T(0.5)));
  }
};

template <class T>
struct Store<BFloat16, T> {
  static FISHEYEREC_INLINE BFloat16 from(T value) {
    const uint32_t bits = bits_from_float(value);
    const uint32_t rounded = value == value ? drop_bits(bits, 16) : 0x7fc0u;
    return {static_cast<uint16_t>(rounded)};
  }
};

template <class T>
struct Store<Float16, T> {
  static FISHEYEREC_INLINE Float16 from(T value) {
    const uint32_t bits = bits_from_float(value);
    const float magnitude = float_from_bits(bits & 0x7fffffffu);
    const uint32_t rounded = drop_bits(bits_from_float(magnitude * 0x1p-112f), 13);
    const uint32_t finite = rounded < 0x7c00u ? rounded : 0x7c00u;
    const uint32_t half = value == value ? finite : 0x7e00u;
    return {static_cast<uint16_t>((bits >> 16 & 0x8000u) | half)};
  }
};

}  // namespace fisheyerec
