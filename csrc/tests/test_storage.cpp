#include <cstdint>
#include <random>

#include "../kernels/storage.h"

#include "check.h"

using namespace fisheyerec;

namespace {

uint16_t float16_bits(float value) { return Storage<Float16>::narrow<float>(value); }
uint16_t bfloat16_bits(float value) { return Storage<BFloat16>::narrow<float>(value); }
float from_float16(uint16_t bits) { return Storage<Float16>::widen<float>(bits); }
float from_bfloat16(uint16_t bits) { return Storage<BFloat16>::widen<float>(bits); }

// Both formats from their definitions, in double, where every step is exact.
double exact_value(uint16_t bits, int mantissa_bits, int exponent_bits) {
  const int exponent = bits >> mantissa_bits & ((1 << exponent_bits) - 1), mantissa = bits & ((1 << mantissa_bits) - 1);
  const int bias = (1 << (exponent_bits - 1)) - 1;
  const double sign = bits & 0x8000 ? -1 : 1;
  if (exponent == (1 << exponent_bits) - 1) {
    return mantissa ? std::numeric_limits<double>::quiet_NaN() : sign * std::numeric_limits<double>::infinity();
  }
  const double significand = exponent ? 1 + std::ldexp(mantissa, -mantissa_bits) : std::ldexp(mantissa, -mantissa_bits);
  return sign * std::ldexp(significand, (exponent ? exponent : 1) - bias);
}

// The nearest, ties to the even one. Positive values of either format are ordered as their bits are.
uint16_t exact_bits(float value, int mantissa_bits, int exponent_bits) {
  const uint16_t sign = std::signbit(value) ? 0x8000 : 0;
  const double magnitude = std::abs(static_cast<double>(value));
  const uint16_t infinity = static_cast<uint16_t>(((1 << exponent_bits) - 1) << mantissa_bits);
  uint16_t low = 0, high = infinity;
  while (high - low > 1) {
    const uint16_t middle = static_cast<uint16_t>((low + high) / 2);
    (exact_value(middle, mantissa_bits, exponent_bits) <= magnitude ? low : high) = middle;
  }
  const double below = exact_value(low, mantissa_bits, exponent_bits);
  // Rounding treats infinity as the next number up.
  const double above =
      high == infinity ? std::ldexp(1.0, 1 << (exponent_bits - 1)) : exact_value(high, mantissa_bits, exponent_bits);
  const bool up = magnitude - below > above - magnitude || (magnitude - below == above - magnitude && low % 2 == 1);
  return static_cast<uint16_t>(sign | (up ? high : low));
}

// Every number, the midpoints between neighbours, and the floats beside those: all the places where rounding turns.
template <class Round>
void check_all_turns(int mantissa_bits, int exponent_bits, const Round& round) {
  constexpr float infinity = std::numeric_limits<float>::infinity();
  const int last = ((1 << exponent_bits) - 1) << mantissa_bits;
  for (int bits = 0; bits < last; ++bits) {
    const double low = exact_value(static_cast<uint16_t>(bits), mantissa_bits, exponent_bits);
    const double high = bits + 1 < last ? exact_value(static_cast<uint16_t>(bits + 1), mantissa_bits, exponent_bits)
                                        : std::ldexp(1.0, 1 << (exponent_bits - 1));
    for (const double at : {low, (low + high) / 2}) {
      const float value = static_cast<float>(at);
      for (const float x : {value, std::nextafter(value, infinity), std::nextafter(value, -infinity)}) {
        CHECK(round(x) == exact_bits(x, mantissa_bits, exponent_bits));
        CHECK(round(-x) == exact_bits(-x, mantissa_bits, exponent_bits));
      }
    }
  }
}

template <class Round>
void check_random(int mantissa_bits, int exponent_bits, const Round& round) {
  std::mt19937 random(11);
  for (int repeat = 0; repeat < 300000; ++repeat) {
    const float value = reinterpret<float>(static_cast<uint32_t>(random()));
    if (std::isnan(value)) continue;
    CHECK(round(value) == exact_bits(value, mantissa_bits, exponent_bits));
  }
}

}  // namespace

TEST(every_half_is_read_exactly_and_written_back_unchanged) {
  for (int i = 0; i < 65536; ++i) {
    const uint16_t bits = static_cast<uint16_t>(i);
    const float half = from_float16(bits), brain = from_bfloat16(bits);
    const double exact_half = exact_value(bits, 10, 5), exact_brain = exact_value(bits, 7, 8);
    if (std::isnan(exact_half)) {
      CHECK(std::isnan(half) && std::isnan(from_float16(float16_bits(half))));
    } else {
      CHECK(half == exact_half && float16_bits(half) == bits);
    }
    if (std::isnan(exact_brain)) {
      CHECK(std::isnan(brain) && std::isnan(from_bfloat16(bfloat16_bits(brain))));
    } else {
      CHECK(brain == exact_brain && bfloat16_bits(brain) == bits);
    }
  }
}

TEST(float16_rounds_to_nearest_even_at_every_turn) {
  check_all_turns(10, 5, float16_bits);
  check_random(10, 5, float16_bits);
}

TEST(bfloat16_rounds_to_nearest_even_at_every_turn) {
  check_all_turns(7, 8, bfloat16_bits);
  check_random(7, 8, bfloat16_bits);
}

TEST(overflow_and_nan_of_halves) {
  constexpr float infinity = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  CHECK(float16_bits(65504.0f) == 0x7bff);
  CHECK(float16_bits(65519.996f) == 0x7bff);
  CHECK(float16_bits(65520.0f) == 0x7c00);
  CHECK(float16_bits(std::numeric_limits<float>::max()) == 0x7c00);
  CHECK(float16_bits(infinity) == 0x7c00 && float16_bits(-infinity) == 0xfc00);
  CHECK(bfloat16_bits(std::numeric_limits<float>::max()) == 0x7f80);
  CHECK(bfloat16_bits(infinity) == 0x7f80 && bfloat16_bits(-infinity) == 0xff80);
  for (const float value : {nan, -nan, reinterpret<float>(0x7f800001u), reinterpret<float>(0xffffffffu)}) {
    CHECK(std::isnan(from_float16(float16_bits(value))));
    CHECK(std::isnan(from_bfloat16(bfloat16_bits(value))));
  }
}

template <class D, int count>
void check_vectors() {
  using T = typename VectorOf<float, count>::type;
  std::mt19937 random(12);
  for (int repeat = 0; repeat < 2000; ++repeat) {
    T values;
    for (int lane = 0; lane < count; ++lane) {
      const uint32_t bits = static_cast<uint32_t>(random());
      values[lane] = std::is_same_v<D, uint8_t> ? static_cast<float>(bits % 25500) / 100 : reinterpret<float>(bits);
    }
    const auto narrow = Storage<D>::template narrow<T>(values);
    const T wide = Storage<D>::template widen<T>(narrow);
    for (int lane = 0; lane < count; ++lane) {
      const float value = values[lane], back = wide[lane];
      CHECK(narrow[lane] == Storage<D>::template narrow<float>(value));
      const float expected = Storage<D>::template widen<float>(narrow[lane]);
      CHECK(back == expected || (std::isnan(back) && std::isnan(expected)));
    }
  }
}

TEST(vectors_of_pixels_are_converted_like_single_ones) {
  check_vectors<uint8_t, 4>(), check_vectors<uint8_t, 8>(), check_vectors<uint8_t, 16>();
  check_vectors<Float16, 4>(), check_vectors<Float16, 8>(), check_vectors<Float16, 16>();
  check_vectors<BFloat16, 4>(), check_vectors<BFloat16, 8>(), check_vectors<BFloat16, 16>();
}

TEST(uint8_rounds_to_the_nearest_level) {
  for (int level = 0; level < 256; ++level) {
    for (const float offset : {-0.499f, 0.0f, 0.499f}) {
      if (level + offset < 0 || level + offset > 255) continue;
      CHECK(Storage<uint8_t>::narrow<float>(static_cast<float>(level) + offset) == level);
    }
  }
  // A weighted mean of 255s may round to a little more.
  CHECK(Storage<uint8_t>::narrow<float>(255.0001f) == 255);
}
