// A smooth function of the column, known at a few columns and wanted at many: the polynomial through 8 of 64 pixels.
//
// The columns lie as Chebyshev's do, denser towards the ends, where the polynomial is then as good as in the middle.
#pragma once

#include "../geometry/lanes.h"

namespace fisheyerec {

struct Piecewise {
  static constexpr int length = 64;     // pixels of one piece
  static constexpr int node_count = 8;  // of which so many are known
  static constexpr int nodes[node_count] = {0, 3, 12, 24, 39, 51, 60, 63};

  alignas(64) float position[length];  // of each pixel on [-1, 1]
  alignas(64) float node_position[node_count];
  alignas(64) float from_values[node_count][node_count];  // [j][k]: what the value at node j adds to c[k] (position^k)

  static constexpr Piecewise make() {
    Piecewise piecewise{};
    const auto position_of = [](int pixel) { return (2.0 * pixel - (length - 1)) / (length - 1); };
    for (int i = 0; i < length; ++i) piecewise.position[i] = static_cast<float>(position_of(i));
    for (int j = 0; j < node_count; ++j) piecewise.node_position[j] = piecewise.position[nodes[j]];
    for (int j = 0; j < node_count; ++j) {  // Lagrange's polynomial: 1 at node j, 0 at the others
      double coefficients[node_count] = {1};
      for (int m = 0, degree = 0; m < node_count; ++m) {
        if (m == j) continue;
        const double root = position_of(nodes[m]), scale = 1 / (position_of(nodes[j]) - root);
        ++degree;
        for (int k = degree; k >= 0; --k) {
          coefficients[k] = ((k > 0 ? coefficients[k - 1] : 0) - root * coefficients[k]) * scale;
        }
      }
      for (int k = 0; k < node_count; ++k) piecewise.from_values[j][k] = static_cast<float>(coefficients[k]);
    }
    return piecewise;
  }
};

constexpr Piecewise piecewise = Piecewise::make();

inline namespace FISHEYEREC_ISA {

using PieceCoefficients = typename VectorOf<float, Piecewise::node_count>::type;

// The polynomial's coefficients from its values at the nodes. False where the function is not smooth enough, or NaN.
//
// How smooth is told by the highest two coefficients of the Chebyshev series, which shrink by a factor from one to the
// next: what the polynomial lacks is less than the two. Two, because either is 0 where the function is even or odd.
FISHEYEREC_INLINE bool fit_piece(const float* values, float* coefficients) {
  constexpr int count = Piecewise::node_count;
  using C = PieceCoefficients;
  // The straight line between the ends is taken out first, as float would round the rest by its size.
  const float middle = (values[0] + values[count - 1]) / 2, slope = (values[count - 1] - values[0]) / 2;
  const C line = middle + slope * load_lanes<C>(piecewise.node_position);
  float bends[count];
  store_lanes(bends, load_lanes<C>(values) - line);
  C sums[2] = {};
  for (int j = 0; j < count; ++j) sums[j % 2] += load_lanes<C>(piecewise.from_values[j]) * bends[j];
  C c = sums[0] + sums[1];
  const float rest = std::abs(c[6]) * 0x1p-5f + std::abs(c[7]) * 0x1p-6f;
  const float size = std::abs(middle) + std::abs(slope);
  c[0] += middle;
  c[1] += slope;
  store_lanes(coefficients, c);
  return rest <= 0x1p-14f + 0x1p-23f * size;  // a fraction of a pixel, and float's own rounding
}

// out[0 .. 63]: the function at the pixels of the piece.
FISHEYEREC_INLINE void evaluate_piece(const float* coefficients, float* out) {
  using T = typename VectorOf<float, FISHEYEREC_VECTOR_BYTES / sizeof(float)>::type;
  for (int i = 0; i < Piecewise::length; i += lanes<T>) {
    const T t = load_lanes<T>(piecewise.position + i);
    T value = splat<T>(coefficients[Piecewise::node_count - 1]);
    for (int k = Piecewise::node_count - 2; k >= 0; --k) value = value * t + coefficients[k];
    store_lanes(out + i, value);
  }
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
