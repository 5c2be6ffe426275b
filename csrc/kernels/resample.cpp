#define FISHEYEREC_ISA dispatch_isa
#include "resample.h"

#include "huge_pages.h"
#include "parallel.h"
#include "rows_table.h"

namespace fisheyerec {
namespace {

// Below this many values a call is over before a second thread has woken up.
constexpr int64_t serial_values = 1 << 14;

template <class T>
const RowKernels<T>& row_kernels() {
  if constexpr (sizeof(T) == 8) {
    return instruction_set().double_rows;
  } else {
    return instruction_set().float_rows;
  }
}

template <class T>
Camera<T> prepare_camera(const Cameras& cameras, int64_t batch, bool unprojects, bool& finite) {
  const double* params = cameras.params + batch * cameras.stride;
  for (int i = 0; i < parameter_count(cameras.model); ++i) finite = finite && std::isfinite(params[i]);
  Camera<T> camera{};
  camera.model = cameras.model;
  if (!finite) return camera;
  switch (cameras.model) {
    case CameraModel::pinhole: camera.pinhole = Pinhole<T>::make(params); break;
    case CameraModel::kannala_brandt: camera.kannala_brandt = KannalaBrandt<T>::make(params, unprojects); break;
    case CameraModel::cylindrical: camera.cylindrical = Cylindrical<T>::make(params); break;
    case CameraModel::equirectangular: camera.equirectangular = Equirectangular<T>::make(params); break;
    case CameraModel::stereographic: camera.stereographic = Stereographic<T>::make(params); break;
    case CameraModel::panini: camera.panini = Panini<T>::make(params); break;
  }
  return camera;
}

template <class T>
std::vector<Geometry<T>> prepare(const Resampling& resampling, int64_t batch) {
  std::vector<Geometry<T>> geometries(static_cast<size_t>(batch));
  for (int64_t b = 0; b < batch; ++b) {
    Geometry<T>& geometry = geometries[static_cast<size_t>(b)];
    geometry.finite = true;
    geometry.source = prepare_camera<T>(resampling.source, b, false, geometry.finite);
    geometry.target = prepare_camera<T>(resampling.target, b, true, geometry.finite);
    geometry.rotated = resampling.source_from_target != nullptr;
    for (int i = 0; i < 9 && geometry.rotated; ++i) {
      const double entry = resampling.source_from_target[b * resampling.rotation_stride + i];
      geometry.source_from_target[i] = static_cast<T>(entry);
      geometry.finite = geometry.finite && std::isfinite(entry);
    }
  }
  return geometries;
}

int useful_threads(const Image& image, int threads) {
  return image.batch * image.channels * image.height * image.width < serial_values ? 1 : threads;
}

// Calls body(batch, row_begin, row_end) over all rows of all images, in about `parts` pieces.
template <class Body>
void for_each_band(int64_t batch, int64_t height, int64_t parts, int threads, const Body& body) {
  const int64_t bands = std::max<int64_t>(1, std::min(height, (parts + batch - 1) / std::max<int64_t>(1, batch)));
  parallel_for(batch * bands, threads, [&](int64_t task) {
    const int64_t band = task % bands;
    body(task / bands, height * band / bands, height * (band + 1) / bands);
  });
}

template <class T>
void forward_in_bands(const ForwardJob<T>& job, int threads) {
  const Image& target = job.target;
  threads = useful_threads(target, threads);
  for_each_band(target.batch, target.height, 8 * threads, threads,
                [&](int64_t batch, int64_t begin, int64_t end) { row_kernels<T>().forward(job, batch, begin, end); });
}

template <class T>
void resample_as(const Resampling& resampling, const Image& source, const Image& target, uint8_t* valid) {
  const std::vector<Geometry<T>> geometries = prepare<T>(resampling, target.batch);
  forward_in_bands(
      ForwardJob<T>{geometries.data(), nullptr, source, target, valid, resampling.interpolation, resampling.padding},
      resampling.threads);
}

template <class T>
void resample_backward_as(const Resampling& resampling, const Image& source, const Image& grad_target,
                          const Gradients& gradients) {
  const int64_t batch_size = grad_target.batch, height = grad_target.height;
  const std::vector<Geometry<T>> geometries = prepare<T>(resampling, batch_size);
  const int threads = useful_threads(grad_target, resampling.threads);
  const bool linear = resampling.interpolation == Interpolation::bilinear;  // nearest has no slope
  const bool want_target = gradients.target_params || gradients.source_from_target;
  const bool want_coordinates = want_target || gradients.source_params;
  std::vector<GeometryGradient> row_gradients(want_coordinates ? static_cast<size_t>(batch_size * height) : 0);
  std::vector<RowRange> row_ranges(
      gradients.source ? static_cast<size_t>(batch_size * height * runs_in_row(grad_target.width)) : 0);
  const BackwardJob<T> job{geometries.data(),
                           source,
                           grad_target,
                           gradients.source,
                           want_coordinates && linear ? row_gradients.data() : nullptr,
                           gradients.source ? row_ranges.data() : nullptr,
                           want_target,
                           resampling.interpolation,
                           resampling.padding};
  for_each_band(batch_size, height, 8 * threads, threads, [&](int64_t batch, int64_t begin, int64_t end) {
    row_kernels<T>().backward_target(job, batch, begin, end);
  });

  if (want_coordinates) {
    for (int64_t batch = 0; batch < batch_size; ++batch) {
      GeometryGradient sum{};
      for (int64_t row = 0; row < height; ++row) {
        const GeometryGradient& part = row_gradients[static_cast<size_t>(batch * height + row)];
        for (int i = 0; i < 8; ++i) sum.source[i] += part.source[i], sum.target[i] += part.target[i];
        for (int i = 0; i < 9; ++i) sum.source_from_target[i] += part.source_from_target[i];
      }
      const auto write = [&](double* out, const double* values, int count) {
        for (int i = 0; out && i < count; ++i) out[batch * count + i] = values[i];
      };
      write(gradients.source_params, sum.source, parameter_count(resampling.source.model));
      write(gradients.target_params, sum.target, parameter_count(resampling.target.model));
      write(gradients.source_from_target, sum.source_from_target, 9);
    }
  }

  // Each source row is owned by one task, which takes the target's pixels in order: no atomics, and the same sums
  // for any number of threads.
  if (gradients.source) {
    for_each_band(
        batch_size, gradients.source->height, threads > 1 ? 4 * threads : 1, threads,
        [&](int64_t batch, int64_t begin, int64_t end) { row_kernels<T>().backward_source(job, batch, begin, end); });
  }
}

template <class Point>
void for_each_point(const Cameras& cameras, int64_t count, const Point& point) {
  bool finite = true;
  const Camera<double> camera = prepare_camera<double>(cameras, 0, true, finite);
  for (int64_t i = 0; i < count; ++i) point(camera, i, finite);
}

}  // namespace

void resample(const Resampling& resampling, const Image& source, const Image& target, uint8_t* valid) {
  if (source.type == ScalarType::float64) {
    resample_as<double>(resampling, source, target, valid);
  } else {
    resample_as<float>(resampling, source, target, valid);
  }
}

Plan::Plan(const Resampling& resampling, int64_t source_height, int64_t source_width, int64_t height, int64_t width)
    : padding_(resampling.padding), valid_(new uint8_t[static_cast<size_t>(height * width)]) {
  const size_t runs = static_cast<size_t>(runs_in_row(width) * height);
  kept_.reset(new KeptRun<float>[runs]);
  ask_for_huge_pages(kept_.get(), runs * sizeof(KeptRun<float>));
  const auto picture = [](int64_t rows, int64_t columns) {
    return Image{nullptr, ScalarType::uint8, 1, 1, rows, columns, 0, 0, 0, 0};
  };
  const Image source = picture(source_height, source_width), target = picture(height, width);
  const std::vector<Geometry<float>> geometry = prepare<float>(resampling, 1);
  const ForwardJob<float> job{geometry.data(),          nullptr,           source, target, valid_.get(),
                              resampling.interpolation, resampling.padding};
  const int threads = useful_threads(target, resampling.threads);
  for_each_band(1, height, 8 * threads, threads,
                [&](int64_t, int64_t begin, int64_t end) { row_kernels<float>().keep(job, kept_.get(), begin, end); });
}

Plan::~Plan() = default;

void Plan::resample(const Image& source, const Image& target, Interpolation interpolation, int threads) const {
  forward_in_bands(ForwardJob<float>{nullptr, kept_.get(), source, target, nullptr, interpolation, padding_}, threads);
}

void resample_backward(const Resampling& resampling, const Image& source, const Image& grad_target,
                       const Gradients& gradients) {
  if (source.type == ScalarType::float64) {
    resample_backward_as<double>(resampling, source, grad_target, gradients);
  } else {
    resample_backward_as<float>(resampling, source, grad_target, gradients);
  }
}

void project(const Cameras& cameras, const double* rays, int64_t count, double* pixels, uint8_t* valid) {
  for_each_point(cameras, count, [&](const Camera<double>& camera, int64_t i, bool finite) {
    const Ray<double> ray{rays[3 * i], rays[3 * i + 1], rays[3 * i + 2]};
    Pixel<double> pixel{};
    bool hit = false;
    with_model(camera, [&](const auto& model) { hit = model.project(ray, pixel); });
    valid[i] = finite && hit && std::isfinite(pixel.x) && std::isfinite(pixel.y);
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    pixels[2 * i] = valid[i] ? pixel.x : nan;
    pixels[2 * i + 1] = valid[i] ? pixel.y : nan;
  });
}

void unproject(const Cameras& cameras, const double* pixels, int64_t count, double* rays, uint8_t* valid) {
  for_each_point(cameras, count, [&](const Camera<double>& camera, int64_t i, bool finite) {
    const Pixel<double> pixel{pixels[2 * i], pixels[2 * i + 1]};
    Ray<double> ray{};
    bool seen = false;
    with_model(camera, [&](const auto& model) { seen = model.unproject(pixel, ray); });
    valid[i] = finite && seen && std::isfinite(ray.x) && std::isfinite(ray.y);
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    rays[3 * i] = valid[i] ? ray.x : nan;
    rays[3 * i + 1] = valid[i] ? ray.y : nan;
    rays[3 * i + 2] = valid[i] ? ray.z : nan;
  });
}

double kannala_brandt_theta_max(const double k[4]) { return monotonic_limit(k); }

}  // namespace fisheyerec
