// The loops of the op over rows of one image of the batch. This header is compiled once per instruction set
// (rows_*.cpp), everything in it and below it within that set's own namespace.
#pragma once

#include "rows_table.h"
#include "sample_bytes.h"

namespace fisheyerec {
inline namespace FISHEYEREC_ISA {

template <class D>
D* pixels(const Image& image, int64_t batch, int64_t row = 0, int64_t column = 0) {
  return static_cast<D*>(image.data) + batch * image.stride_batch + row * image.stride_y + column * image.stride_x;
}

// Calls visit with a null pointer of the storage type of pixels that are computed in T. (Bytes are computed in whole
// numbers, sample_bytes.h.)
template <class T, class Visit>
void with_storage(ScalarType type, const Visit& visit) {
  if constexpr (sizeof(T) == 8) {
    visit(static_cast<double*>(nullptr));
  } else {
    switch (type) {
      case ScalarType::uint16: return visit(static_cast<uint16_t*>(nullptr));
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
    case ScalarType::uint16:
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

// valid[i] = whether (x, y)[i] lies on the source image.
template <class S>
FISHEYEREC_NOINLINE void mark_valid(const Image& source, int count, const S* x, const S* y, uint8_t* valid) {
  using T = Pack<S>;
  alignas(64) uint8_t marks[run_length];
  for (int i = 0; i < count; i += lanes<T>) {
    const Mask<T> on_image = inside(load_lanes<T>(x + i), static_cast<S>(source.width)) &
                             inside(load_lanes<T>(y + i), static_cast<S>(source.height));
    store_lanes(marks + i, convert<Like<uint8_t, T>>(select(on_image, splat<Index<T>>(1), splat<Index<T>>(0))));
  }
  std::memcpy(valid, marks, static_cast<size_t>(count));
}

// Coordinates of a run of target pixels, and its marks in job.valid. Returns is_interior().
template <class T>
FISHEYEREC_INLINE bool map_and_mark_run(const ForwardJob<T>& job, int64_t batch, int64_t row, int64_t column, int count,
                                        T* x, T* y) {
  map_run(job.geometries[batch], row, column, count, x, y);
  const bool interior = is_interior(job.source, count, x, y);
  uint8_t* valid = job.valid + (batch * job.target.height + row) * job.target.width + column;
  if (interior) {
    std::memset(valid, 1, static_cast<size_t>(count));
  } else {
    mark_valid(job.source, count, x, y, valid);
  }
  return interior;
}

template <class T>
void keep_rows(const ForwardJob<T>& job, KeptRun<T>* kept, int64_t row_begin, int64_t row_end) {
  for_each_run(job.target.width, row_begin, row_end, [&](int64_t row, int64_t column, int count) {
    KeptRun<T>& run = kept[kept_at(job.target.height, row, column)];
    run.interior = map_and_mark_run(job, 0, row, column, count, run.x, run.y);
  });
}

// The hardware foresees what lies side by side, but not beyond a page, and a run is half of one.
template <class T>
FISHEYEREC_INLINE void prefetch_run(const KeptRun<T>* run) {
  const char* bytes = reinterpret_cast<const char*>(run);
  for (size_t line = 0; line < sizeof *run; line += 64) __builtin_prefetch(bytes + line);
}

template <class T>
void forward_rows(const ForwardJob<T>& job, int64_t batch, int64_t row_begin, int64_t row_end) {
  const Image &source = job.source, &target = job.target;
  alignas(64) T mapped_x[run_length], mapped_y[run_length];
  const T *x = mapped_x, *y = mapped_y;
  Taps<T> taps;
  // sample(source_pixels, target_pixels, count, interior) from x and y.
  const auto for_each_run_of = [&](auto* storage, const auto& sample) {
    using D = std::remove_pointer_t<decltype(storage)>;
    for_each_run(target.width, row_begin, row_end, [&](int64_t row, int64_t column, int count) {
      bool interior;
      if (job.kept) {
        const KeptRun<T>& run = job.kept[kept_at(target.height, row, column)];
        prefetch_run(&run + 1);
        x = run.x, y = run.y, interior = run.interior;
      } else {
        interior = map_and_mark_run(job, batch, row, column, count, mapped_x, mapped_y);
      }
      sample(pixels<const D>(source, batch), pixels<D>(target, batch, row, column), count, interior);
    });
  };
  const auto take = [&](int count, bool interior) {
    take_taps(source, job.interpolation, job.padding, interior, count, x, y, false, taps);
  };
  if (job.interpolation == Interpolation::nearest) {
    with_bytes(source.type, [&](auto* storage) {
      for_each_run_of(storage, [&](const auto* from, auto* to, int count, bool interior) {
        take(count, interior);
        copy_run(source, from, taps, count, target, to);
      });
    });
    return;
  }
  if constexpr (sizeof(T) == 4) {
    if (source.type == ScalarType::uint8) {
      ByteTaps byte_taps;
      const bool has_neighbours = source.width > 1 && source.height > 1 && has_narrow_offsets(source);
      return for_each_run_of(static_cast<uint8_t*>(nullptr), [&](const auto* from, auto* to, int count, bool interior) {
        if (interior && has_neighbours) {
          take_interior_byte_taps(source, count, x, y, byte_taps);
          sample_run(source, from, byte_taps, source.stride_x, source.stride_y, count, target, to);
        } else {
          take(count, interior);
          take_byte_taps(taps, count, byte_taps);
          sample_run(source, from, byte_taps, taps.right, taps.below, count, target, to);
        }
      });
    }
  }
  with_storage<T>(source.type, [&](auto* storage) {
    for_each_run_of(storage, [&](const auto* from, auto* to, int count, bool interior) {
      take(count, interior);
      sample_run(source, from, taps, count, target, to);
    });
  });
}

template <class S>
RowRange rows_read(const Taps<S>& taps, int count) {
  using I = Index<Pack<S>>;
  const auto smaller = [](const auto& a, const auto& b) { return select(a < b, a, b); };
  const I none = splat<I>(std::numeric_limits<int32_t>::max());
  I first = none, negative_last = none;  // the last row, negative, so that both are minima
  for (int i = 0; i < count; i += lanes<Pack<S>>) {
    const I row = load_lanes<I>(taps.row + i);
    const auto read = (load_lanes<I>(taps.live + i) != splat<I>(0)) & (count_from<I>(i) < splat<I>(count));
    first = smaller(first, select(read, row, none));
    negative_last = smaller(negative_last, select(read, -row, none));
  }
  RowRange range{std::numeric_limits<int32_t>::max(), -1};
  int32_t firsts[lanes<I>], negative_lasts[lanes<I>];
  store_lanes(firsts, first);
  store_lanes(negative_lasts, negative_last);
  for (int lane = 0; lane < lanes<I>; ++lane) {
    range.first = smaller(range.first, firsts[lane]);
    range.last = -smaller(-range.last, negative_lasts[lane]);
  }
  range.last += taps.two_rows && range.last >= 0;
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
      take_taps(source, job.interpolation, job.padding, is_interior(source, count, x, y), count, x, y,
                job.row_gradients != nullptr, taps);
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
      const bool interior = is_interior(grad_source, count, x, y);
      take_taps(grad_source, job.interpolation, job.padding, interior, count, x, y, false, taps);
      sample_run_adjoint_image(grad_source, pixels<T>(grad_source, batch), taps, count, grad_target,
                               pixels<const D>(grad_target, batch, row, column),
                               Selection(taps, count, range, interior, band));
    });
  });
}

template <class T>
constexpr RowKernels<T> row_kernels() {
  return {forward_rows<T>, keep_rows<T>, backward_target_rows<T>, backward_source_rows<T>};
}

}  // namespace FISHEYEREC_ISA
}  // namespace fisheyerec
