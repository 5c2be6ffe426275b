// The three loops of the op over rows of one image of the batch. This header is compiled once per instruction set
// (rows_*.cpp), everything in it and below it within that set's own namespace.
#pragma once

#include "rows_table.h"
#include "sample.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

template <class D>
D* pixels(const Image& image, int64_t batch, int64_t row = 0, int64_t column = 0) {
  return static_cast<D*>(image.data) + batch * image.stride_batch + row * image.stride_y + column * image.stride_x;
}

// Calls visit with a null pointer of the storage type of pixels that are computed in T.
template <class T, class Visit>
void with_storage(ScalarType type, const Visit& visit) {
  if constexpr (sizeof(T) == 8) {
    visit(static_cast<double*>(nullptr));
  } else {
    switch (type) {
      case ScalarType::uint8: return visit(static_cast<uint8_t*>(nullptr));
      case ScalarType::float16: return visit(static_cast<Float16*>(nullptr));
      case ScalarType::bfloat16: return visit(static_cast<BFloat16*>(nullptr));
      default: return visit(static_cast<float*>(nullptr));
    }
  }
}

// Calls visit with a null pointer of an unsigned integer as wide as `type`.
template <class Visit>
void with_bytes(ScalarType type, const Visit& visit) {
  switch (type) {
    case ScalarType::uint8: return visit(static_cast<uint8_t*>(nullptr));
    case ScalarType::int16:
    case ScalarType::float16:
    case ScalarType::bfloat16: return visit(static_cast<uint16_t*>(nullptr));
    case ScalarType::int32:
    case ScalarType::float32: return visit(static_cast<uint32_t*>(nullptr));
    case ScalarType::int64:
    case ScalarType::float64: return visit(static_cast<uint64_t*>(nullptr));
  }
}

// Walks target rows in runs: visit(row, column, count). Down the rows first, so that the source rows which one run
// reads are still in the cache for the run below it.
template <class Visit>
FISHEYEREC_INLINE void for_each_run(int64_t width, int64_t row_begin, int64_t row_end, const Visit& visit) {
  for (int64_t column = 0; column < width; column += run_length) {
    const int count = static_cast<int>(width - column < run_length ? width - column : run_length);
    for (int64_t row = row_begin; row < row_end; ++row) visit(row, column, count);
  }
}

template <class T>
void forward_rows(const ForwardJob<T>& job, int64_t batch, int64_t row_begin, int64_t row_end) {
  const Image &source = job.source, &target = job.target;
  alignas(64) T x[run_length], y[run_length];
  Taps<T> taps;
  const auto run = [&](auto* storage, auto sample) {
    using D = std::remove_pointer_t<decltype(storage)>;
    for_each_run(target.width, row_begin, row_end, [&](int64_t row, int64_t column, int count) {
      map_run(job.geometries[batch], row, column, count, x, y);
      take_taps(source, job.interpolation, job.padding, count, x, y, false, taps);
      uint8_t* valid = job.valid + (batch * target.height + row) * target.width + column;
      for (int i = 0; i < count; ++i) {
        valid[i] = inside(x[i], static_cast<T>(source.width)) & inside(y[i], static_cast<T>(source.height));
      }
      sample(source, pixels<D>(source, batch), taps, count, target, pixels<D>(target, batch, row, column));
    });
  };
  if (job.interpolation == Interpolation::nearest) {
    with_bytes(source.type, [&](auto* storage) { run(storage, [](auto&&... args) { copy_run(args...); }); });
  } else {
    with_storage<T>(source.type, [&](auto* storage) { run(storage, [](auto&&... args) { sample_run(args...); }); });
  }
}

template <class S>
RowRange rows_read(const Taps<S>& taps, int count) {
  RowRange range{std::numeric_limits<int32_t>::max(), -1};
  for (int i = 0; i < count; ++i) {
    const int32_t last = taps.row[i] + taps.two_rows;
    range.first = taps.live[i] && taps.row[i] < range.first ? taps.row[i] : range.first;
    range.last = taps.live[i] && last > range.last ? last : range.last;
  }
  return range;
}

template <class T>
void backward_target_rows(const BackwardJob<T>& job, int64_t batch, int64_t row_begin, int64_t row_end) {
  const Image &source = job.source, &grad_target = job.grad_target;
  const int64_t runs = runs_in_row(grad_target.width);
  alignas(64) T x[run_length], y[run_length];
  Taps<T> taps;
  with_storage<T>(source.type, [&](auto* storage) {
    using D = std::remove_pointer_t<decltype(storage)>;
    for_each_run(grad_target.width, row_begin, row_end, [&](int64_t row, int64_t column, int count) {
      const int64_t row_index = batch * grad_target.height + row;
      map_run(job.geometries[batch], row, column, count, x, y);
      take_taps(source, job.interpolation, job.padding, count, x, y, job.row_gradients != nullptr, taps);
      if (job.row_ranges) job.row_ranges[row_index * runs + column / run_length] = rows_read(taps, count);
      if (!job.row_gradients) return;
      alignas(64) T grad_x[run_length], grad_y[run_length];
      sample_run_adjoint_coordinates(source, pixels<const D>(source, batch), taps, count, grad_target,
                                     pixels<const D>(grad_target, batch, row, column), grad_x, grad_y);
      map_run_adjoint(job.geometries[batch], row, column, count, grad_x, grad_y, job.want_target,
                      job.row_gradients[row_index]);
    });
  });
}

template <class T>
void fill_zero(const Image& image, int64_t batch, int64_t row_begin, int64_t row_end) {
  const bool dense_row = image.interleaved() && image.stride_x == image.channels;
  const int64_t parts = dense_row ? 1 : image.channels;
  for (int64_t part = 0; part < parts; ++part) {
    for (int64_t row = row_begin; row < row_end; ++row) {
      T* out = pixels<T>(image, batch, row) + part * image.stride_channel;
      if (dense_row || image.stride_x == 1) {
        std::memset(out, 0, static_cast<size_t>(dense_row ? image.width * image.channels : image.width) * sizeof(T));
      } else {
        for (int64_t column = 0; column < image.width; ++column) out[column * image.stride_x] = 0;
      }
    }
  }
}

template <class T>
void backward_source_rows(const BackwardJob<T>& job, int64_t batch, int64_t row_begin, int64_t row_end) {
  const Image &grad_target = job.grad_target, &grad_source = *job.grad_source;
  const int64_t runs = runs_in_row(grad_target.width);
  const RowRange band{static_cast<int32_t>(row_begin), static_cast<int32_t>(row_end - 1)};
  fill_zero<T>(grad_source, batch, row_begin, row_end);
  alignas(64) T x[run_length], y[run_length];
  Taps<T> taps;
  with_storage<T>(job.source.type, [&](auto* storage) {
    using D = std::remove_pointer_t<decltype(storage)>;
    for_each_run(grad_target.width, 0, grad_target.height, [&](int64_t row, int64_t column, int count) {
      const RowRange& range = job.row_ranges[(batch * grad_target.height + row) * runs + column / run_length];
      if (range.last < band.first || range.first > band.last) return;
      map_run(job.geometries[batch], row, column, count, x, y);
      take_taps(grad_source, job.interpolation, job.padding, count, x, y, false, taps);
      sample_run_adjoint_image(grad_source, pixels<T>(grad_source, batch), taps, count, grad_target,
                               pixels<const D>(grad_target, batch, row, column), band);
    });
  });
}

template <class T>
constexpr RowKernels<T> row_kernels() {
  return {forward_rows<T>, backward_target_rows<T>, backward_source_rows<T>};
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
