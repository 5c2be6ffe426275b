// Tier 3 for NumPy: arrays in and out of tier 2 by pybind11. Imports no torch.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "../kernels/parallel.h"
#include "../kernels/resample.h"

namespace py = pybind11;
using DoubleArray = py::array_t<double, py::array::c_style | py::array::forcecast>;

namespace {

fisheyerec::CameraModel camera_model(const std::string& name) {
  int32_t model = 0;
  for (const char* known : fisheyerec::camera_model_names) {
    if (name == known) return static_cast<fisheyerec::CameraModel>(model);
    ++model;
  }
  throw py::value_error("expected a camera model such as pinhole or kannala_brandt, got " + name);
}

fisheyerec::Cameras as_camera(const std::string& model, const DoubleArray& params) {
  const fisheyerec::CameraModel camera = camera_model(model);
  if (params.ndim() != 1 || params.shape(0) != parameter_count(camera)) {
    throw py::value_error("expected " + std::to_string(parameter_count(camera)) + " parameters of a " + model +
                          " camera");
  }
  return {camera, params.data(), 0};
}

fisheyerec::ScalarType scalar_type(const py::array& array) {
  using fisheyerec::ScalarType;
  const char kind = array.dtype().kind();
  const auto size = array.dtype().itemsize();
  const bool integral = kind == 'i' || kind == 'u' || kind == 'b';
  if (!array.dtype().attr("isnative").cast<bool>()) throw py::value_error("expected an image in native byte order");
  if (kind == 'f' && size == 2) return ScalarType::float16;
  if (kind == 'f' && size == 4) return ScalarType::float32;
  if (kind == 'f' && size == 8) return ScalarType::float64;
  if (integral && size == 1) return ScalarType::uint8;
  if (kind == 'u' && size == 2) return ScalarType::uint16;
  if (integral && size == 2) return ScalarType::int16;
  if (integral && size == 4) return ScalarType::int32;
  if (integral && size == 8) return ScalarType::int64;
  throw py::value_error("expected an image of bool, integers, float16, float32 or float64");
}

// A (height, width, channels) array; tier 2 takes its strides as they are, negative ones too.
fisheyerec::Image as_image(const py::array& array) {
  const auto stride = [&](int axis) {
    if (array.strides(axis) % array.itemsize() != 0) throw py::value_error("expected strides of whole elements");
    return static_cast<int64_t>(array.strides(axis) / array.itemsize());
  };
  return {const_cast<void*>(array.data()),
          scalar_type(array),
          1,
          array.shape(2),
          array.shape(0),
          array.shape(1),
          0,
          stride(2),
          stride(0),
          stride(1)};
}

// Channels must lie side by side as in the result; rows and pixels may have any strides.
py::array with_dense_channels(const py::array& image) {
  const bool dense = image.shape(2) == 1 || image.strides(2) == image.itemsize();
  return dense ? image : py::array::ensure(image, py::array::c_style);
}

void check_picture(const py::array& image) {
  if (image.ndim() != 3) throw py::value_error("expected an image (height, width, channels)");
  if (image.shape(0) < 1 || image.shape(1) < 1 || image.shape(0) > fisheyerec::max_size ||
      image.shape(1) > fisheyerec::max_size) {
    throw py::value_error("expected an image with pixels");
  }
}

void check_size(int64_t height, int64_t width) {
  if (height < 1 || width < 1 || height > fisheyerec::max_size || width > fisheyerec::max_size) {
    throw py::value_error("expected a height and width in [1, 2^30]");
  }
}

int thread_count(int threads) { return threads > 0 ? threads : fisheyerec::default_thread_count(); }

fisheyerec::Interpolation as_interpolation(const std::string& name, const py::array& image) {
  if (name == "nearest") return fisheyerec::Interpolation::nearest;
  if (name != "bilinear") throw py::value_error("unknown interpolation " + name);
  const char kind = image.dtype().kind();
  if (kind != 'f' && !(kind == 'u' && image.itemsize() <= 2)) {
    throw py::value_error("bilinear expects a floating, uint8 or uint16 image; use nearest for labels");
  }
  return fisheyerec::Interpolation::bilinear;
}

// Points into its arguments.
fisheyerec::Resampling as_resampling(const std::string& source_model, const DoubleArray& source,
                                     const std::string& target_model, const DoubleArray& target,
                                     const std::optional<DoubleArray>& source_from_target,
                                     fisheyerec::Interpolation interpolation, const std::string& padding, int threads) {
  if (padding != "zeros" && padding != "border") throw py::value_error("unknown padding " + padding);
  if (source_from_target && source_from_target->size() != 9) throw py::value_error("expected a rotation (3, 3)");
  return {as_camera(source_model, source),
          as_camera(target_model, target),
          source_from_target ? source_from_target->data() : nullptr,
          0,
          interpolation,
          padding == "zeros" ? fisheyerec::Padding::zeros : fisheyerec::Padding::border,
          thread_count(threads)};
}

py::tuple resample(const py::array& given_image, const std::string& source_model, const DoubleArray& source,
                   const std::string& target_model, const DoubleArray& target,
                   const std::optional<DoubleArray>& source_from_target, int64_t height, int64_t width,
                   const std::string& interpolation, const std::string& padding, int threads) {
  check_picture(given_image);
  check_size(height, width);
  const py::array image = with_dense_channels(given_image);
  const fisheyerec::Resampling resampling =
      as_resampling(source_model, source, target_model, target, source_from_target,
                    as_interpolation(interpolation, image), padding, threads);
  const fisheyerec::Image input = as_image(image);
  py::array out(image.dtype(), std::vector<py::ssize_t>{height, width, image.shape(2)});
  py::array_t<bool> valid({height, width});
  const fisheyerec::Image output = as_image(out);
  uint8_t* valid_data = reinterpret_cast<uint8_t*>(valid.mutable_data());
  {
    py::gil_scoped_release release;
    fisheyerec::resample(resampling, input, output, valid_data);
  }
  return py::make_tuple(out, valid);
}

// fisheyerec::Plan with the sizes it was made for.
struct Plan {
  int64_t source_height, source_width, height, width;
  std::unique_ptr<const fisheyerec::Plan> plan;

  Plan(const std::string& source_model, const DoubleArray& source, int64_t given_source_height,
       int64_t given_source_width, const std::string& target_model, const DoubleArray& target, int64_t given_height,
       int64_t given_width, const std::optional<DoubleArray>& source_from_target, const std::string& padding,
       int threads)
      : source_height(given_source_height), source_width(given_source_width), height(given_height), width(given_width) {
    check_size(source_height, source_width);
    check_size(height, width);
    const fisheyerec::Resampling resampling =
        as_resampling(source_model, source, target_model, target, source_from_target,
                      fisheyerec::Interpolation::bilinear, padding, threads);
    py::gil_scoped_release release;
    plan = std::make_unique<const fisheyerec::Plan>(resampling, source_height, source_width, height, width);
  }

  py::array resample(const py::array& given_image, const std::string& interpolation, int threads) const {
    check_picture(given_image);
    if (given_image.shape(0) != source_height || given_image.shape(1) != source_width) {
      throw py::value_error("expected an image of the size that the plan was made for");
    }
    const fisheyerec::Interpolation chosen = as_interpolation(interpolation, given_image);
    const py::array image = with_dense_channels(given_image);
    const fisheyerec::Image input = as_image(image);
    if (input.type == fisheyerec::ScalarType::float64) throw py::value_error("a plan keeps float32 coordinates");
    py::array out(image.dtype(), std::vector<py::ssize_t>{height, width, image.shape(2)});
    const fisheyerec::Image output = as_image(out);
    threads = thread_count(threads);
    {
      py::gil_scoped_release release;
      plan->resample(input, output, chosen, threads);
    }
    return out;
  }

  py::array_t<bool> valid() const {
    return py::array_t<bool>({height, width}, reinterpret_cast<const bool*>(plan->valid()));
  }
};

using PointKernel = void (*)(const fisheyerec::Cameras&, const double*, int64_t, double*, uint8_t*);

template <PointKernel kernel, int in_size, int out_size>
py::tuple transform(const std::string& model, const DoubleArray& params, const DoubleArray& points) {
  if (points.ndim() != 2 || points.shape(1) != in_size) {
    throw py::value_error("expected an array (N, " + std::to_string(in_size) + ")");
  }
  const fisheyerec::Cameras camera = as_camera(model, params);
  py::array_t<double> out({points.shape(0), static_cast<py::ssize_t>(out_size)});
  py::array_t<bool> valid(points.shape(0));
  kernel(camera, points.data(), points.shape(0), out.mutable_data(), reinterpret_cast<uint8_t*>(valid.mutable_data()));
  return py::make_tuple(out, valid);
}

}  // namespace

PYBIND11_MODULE(_numpy, m) {
  m.doc() = "The resampling kernels on NumPy arrays; fisheyerec.numpy is the public face.";
  m.def("resample", &resample);
  py::class_<Plan>(m, "Plan")
      .def(py::init<const std::string&, const DoubleArray&, int64_t, int64_t, const std::string&, const DoubleArray&,
                    int64_t, int64_t, const std::optional<DoubleArray>&, const std::string&, int>())
      .def("resample", &Plan::resample)
      .def("valid", &Plan::valid);
  m.def("project", &transform<fisheyerec::project, 3, 2>);
  m.def("unproject", &transform<fisheyerec::unproject, 2, 3>);
  m.def("theta_max", [](const DoubleArray& k) {
    if (k.ndim() != 1 || k.shape(0) != 4) throw py::value_error("expected k1..k4");
    return fisheyerec::kannala_brandt_theta_max(k.data());
  });
}
