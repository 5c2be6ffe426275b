// What resample.cpp asks of one instruction set, and the sets there are.
#pragma once

#include "map.h"

namespace fisheyerec {

// What a plan keeps of one run of target pixels.
template <class T>
struct KeptRun {
  alignas(64) T x[run_length], y[run_length];
  bool interior;  // taps.h
};

// Where a run is kept: in the order in which runs are walked, down the rows and then to the right.
inline int64_t kept_at(int64_t height, int64_t row, int64_t column) { return column / run_length * height + row; }

template <class T>
struct ForwardJob {
  const Geometry<T>* geometries;  // one per image of the batch; not read where coordinates are kept
  const KeptRun<T>* kept;         // of every image alike, or null
  Image source, target;
  uint8_t* valid;  // not written where coordinates are kept
  Interpolation interpolation;
  Padding padding;
};

// The source rows that one run of target pixels reads: [first, last], empty where it reads nothing.
struct RowRange {
  int32_t first, last;
};

template <class T>
struct BackwardJob {
  const Geometry<T>* geometries;
  Image source, grad_target;
  const Image* grad_source;         // pixels of type T, or null
  GeometryGradient* row_gradients;  // (batch, target height), or null
  RowRange* row_ranges;             // (batch, target height, runs in a row), or null
  bool want_target;                 // also the target camera's and the rotation's gradients
  Interpolation interpolation;
  Padding padding;
};

inline int64_t runs_in_row(int64_t width) { return (width + run_length - 1) / run_length; }

template <class T>
struct RowKernels {
  void (*forward)(const ForwardJob<T>&, int64_t batch, int64_t row_begin, int64_t row_end);
  // Rows of the target of a single image: writes what forward() may read as kept, and valid. No pixel is read.
  void (*keep)(const ForwardJob<T>&, KeptRun<T>* kept, int64_t row_begin, int64_t row_end);
  // Rows of the target: adds to row_gradients, writes row_ranges.
  void (*backward_target)(const BackwardJob<T>&, int64_t batch, int64_t row_begin, int64_t row_end);
  // Rows of the source, each owned by one call: writes grad_source there; reads row_ranges.
  void (*backward_source)(const BackwardJob<T>&, int64_t batch, int64_t row_begin, int64_t row_end);
};

struct InstructionSet {
  RowKernels<float> float_rows;
  RowKernels<double> double_rows;
};

extern const InstructionSet baseline;
#if defined(__x86_64__) && defined(__GNUC__)
extern const InstructionSet avx2, avx512;
#endif

// The best set this processor has. FISHEYEREC_ISA=baseline|avx2|avx512 in the environment asks for a lower one, which
// is how tests compare them.
const InstructionSet& instruction_set();

}  // namespace fisheyerec
