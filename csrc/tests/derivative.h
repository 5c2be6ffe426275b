// Derivatives by central differences of sixth order: with double precision about eleven correct digits, enough to
// tell a wrong adjoint from a rounded one.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

namespace fisheyerec {

struct Derivative {
  double value;
  double rounding;  // what the rounding of f alone may contribute
};

// df/dx at the current value of x; step should be about 1/200 of the scale on which f changes.
template <class F>
Derivative derivative(const F& f, double& x, double step) {
  const double at = x;
  double largest = 0;
  const auto value = [&](int steps) {
    x = at + steps * step;
    const double result = f();
    largest = std::max(largest, std::abs(result));
    return result;
  };
  const double sum = 45 * (value(1) - value(-1)) - 9 * (value(2) - value(-2)) + (value(3) - value(-3));
  x = at;
  // Steps below the spacing of x itself are not what they claim to be.
  const double spacing = std::numeric_limits<double>::epsilon() * std::abs(at) / step;
  const double slope = sum / (60 * step);
  return {slope, 8 * std::numeric_limits<double>::epsilon() * largest / step + 4 * spacing * std::abs(slope)};
}

}  // namespace fisheyerec
