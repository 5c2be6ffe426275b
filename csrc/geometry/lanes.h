// What lets one copy of the maths run on one pixel or on a vector of them: the formulas are templated on T, which is
// float, double, or a compiler vector of floats, and say select() where a scalar program would branch.
//
// The vectors are GCC's and Clang's own (arithmetic, comparisons and ?: work lane by lane), which compile to whatever
// the target has. docs/decisions/0003 tells why not auto-vectorisation or a SIMD library.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <utility>

// Never emitted as a symbol of its own, so that one header can be compiled for several instruction sets within
// one binary without the linker picking the wrong copy.
#define FISHEYEREC_INLINE inline __attribute__((always_inline))

// For inner loops, which lose their registers when everything around them is inlined into one function.
#define FISHEYEREC_NOINLINE __attribute__((noinline))

// The width of vectors in bytes; each rows_*.cpp says its own.
#ifndef FISHEYEREC_VECTOR_BYTES
#define FISHEYEREC_VECTOR_BYTES 16
#endif

namespace fisheyerec {

template <class S, int count>
struct VectorOf {
  typedef S type __attribute__((vector_size(count * sizeof(S))));
};

// Scalar: the number type of a lane. Index, Mask: what truncating and comparing T give.
template <class T, bool scalar = std::is_arithmetic_v<T>>
struct Numeric {
  using Scalar = T;
  static constexpr int lanes = 1;
  using Index = int32_t;
  using Mask = bool;
};
template <class T>
struct Numeric<T, false> {
  using Scalar = std::decay_t<decltype(std::declval<T>()[0])>;
  static constexpr int lanes = sizeof(T) / sizeof(Scalar);
  using Index = typename VectorOf<int32_t, lanes>::type;
  using Mask = Index;
};

template <class T>
using Scalar = typename Numeric<T>::Scalar;
template <class T>
using Index = typename Numeric<T>::Index;
template <class T>
using Mask = typename Numeric<T>::Mask;
template <class T>
constexpr int lanes = Numeric<T>::lanes;
template <class T>
constexpr bool is_vector = !std::is_arithmetic_v<T>;

// The same value in every lane; Target is T or Index<T>.
template <class Target, class S>
FISHEYEREC_INLINE Target splat(S value) {
  if constexpr (is_vector<Target>) {
    // Minus zero, which compilers drop; plus zero would turn -0 into 0 and so stays an addition.
    return static_cast<std::decay_t<decltype(Target{}[0])>>(value) - Target{};
  } else {
    return static_cast<Target>(value);
  }
}

// Both values are computed, then one is taken; conditions are joined by & and |, not && and ||.
template <class M, class T>
FISHEYEREC_INLINE T select(M condition, T if_true, T if_false) {
  return condition ? if_true : if_false;
}

template <class T>
FISHEYEREC_INLINE T square_root(T value) {
  if constexpr (is_vector<T>) {
    T root;
    for (int lane = 0; lane < lanes<T>; ++lane) root[lane] = __builtin_sqrtf(value[lane]);
    return root;
  } else {
    return std::sqrt(value);
  }
}

// Rounds towards zero; values must fit.
template <class T>
FISHEYEREC_INLINE Index<T> truncate(T value) {
  if constexpr (is_vector<T>) {
    return __builtin_convertvector(value, Index<T>);
  } else {
    return static_cast<Index<T>>(value);
  }
}

template <class T>
FISHEYEREC_INLINE T to_real(Index<T> index) {
  if constexpr (is_vector<T>) {
    return __builtin_convertvector(index, T);
  } else {
    return static_cast<T>(index);
  }
}

template <class To, class From>
FISHEYEREC_INLINE To reinterpret(const From& from) {
  static_assert(sizeof(To) == sizeof(From));
  To to;
  std::memcpy(&to, &from, sizeof to);
  return to;
}

template <class T>
FISHEYEREC_INLINE T load_lanes(const void* memory) {
  T values;
  std::memcpy(&values, memory, sizeof values);
  return values;
}

template <class T>
FISHEYEREC_INLINE void store_lanes(void* memory, const T& values) {
  std::memcpy(memory, &values, sizeof values);
}

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

// Lanes first, first + 2, first + 4, ... of a followed by b.
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

// first and second: the floats at pair(lane)[0] and pair(lane)[1], each pair fetched by one load of 64 bits.
template <class T, class Pair>
FISHEYEREC_INLINE void gather_pairs(const Pair& pair, T& first, T& second) {
  constexpr int half = lanes<T> / 2;
  using Pairs = typename VectorOf<uint64_t, half>::type;
  const T low = reinterpret<T>(from_lanes<Pairs>([&](int lane) { return load_lanes<uint64_t>(pair(lane)); }));
  const T high = reinterpret<T>(from_lanes<Pairs>([&](int lane) { return load_lanes<uint64_t>(pair(half + lane)); }));
  constexpr auto all = std::make_integer_sequence<int, lanes<T>>{};
  first = every_second<0>(low, high, all);
  second = every_second<1>(low, high, all);
}

// table[index] and table[index + 1], lane by lane.
template <class T>
FISHEYEREC_INLINE void lookup_pair(const Scalar<T>* table, Index<T> index, T& first, T& second) {
  if constexpr (is_vector<T>) {
    gather_pairs([&](int lane) { return table + index[lane]; }, first, second);
  } else {
    first = table[index];
    second = table[index + 1];
  }
}

// first, first + 1, ... in the lanes.
template <class T>
FISHEYEREC_INLINE T count_from(Scalar<T> first) {
  if constexpr (is_vector<T>) {
    T values;
    for (int lane = 0; lane < lanes<T>; ++lane) values[lane] = static_cast<Scalar<T>>(lane);
    return values + first;
  } else {
    return first;
  }
}

}  // namespace fisheyerec
