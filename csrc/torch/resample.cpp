// Tier 3 for torch: schemas, checks that keep memory safe, allocation, and the call into tier 2. Nothing here loops
// over pixels. Built on LibTorch's stable ABI, so that one binary serves every torch from 2.10 on.
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "../kernels/huge_pages.h"
#include "../kernels/resample.h"

namespace {

using torch::headeronly::MemoryFormat;
using torch::stable::Tensor;
using DType = torch::headeronly::ScalarType;

std::vector<int64_t> sizes_of(const Tensor& tensor) {
  std::vector<int64_t> sizes;
  for (int64_t i = 0; i < tensor.dim(); ++i) sizes.push_back(tensor.size(i));
  return sizes;
}

std::string text(const std::vector<int64_t>& shape) {
  std::string out = "(";
  for (size_t i = 0; i < shape.size(); ++i) out += (i ? ", " : "") + std::to_string(shape[i]);
  return out + ")";
}

fisheyerec::ScalarType scalar_type(const Tensor& tensor, const char* op) {
  using fisheyerec::ScalarType;
  switch (tensor.scalar_type()) {
    case DType::Bool:
    case DType::Char:
    case DType::Byte: return ScalarType::uint8;
    case DType::UInt16:
    case DType::Short: return ScalarType::int16;
    case DType::UInt32:
    case DType::Int: return ScalarType::int32;
    case DType::UInt64:
    case DType::Long: return ScalarType::int64;
    case DType::Half: return ScalarType::float16;
    case DType::BFloat16: return ScalarType::bfloat16;
    case DType::Float: return ScalarType::float32;
    case DType::Double: return ScalarType::float64;
    default: STD_TORCH_CHECK(false, op, "(): image has a dtype this op does not know"); return {};
  }
}

bool is_floating(fisheyerec::ScalarType type) { return type >= fisheyerec::ScalarType::float16; }

fisheyerec::Image as_image(const Tensor& tensor, const char* op) {
  return {tensor.data_ptr(), scalar_type(tensor, op), tensor.size(0),   tensor.size(1),   tensor.size(2),
          tensor.size(3),    tensor.stride(0),        tensor.stride(1), tensor.stride(2), tensor.stride(3)};
}

Tensor empty(const std::vector<int64_t>& shape, DType dtype, MemoryFormat format = MemoryFormat::Contiguous) {
  const torch::stable::Device cpu(torch::headeronly::DeviceType::CPU);
  const Tensor tensor = torch::stable::empty(shape, dtype, std::nullopt, cpu, std::nullopt, format);
  fisheyerec::ask_for_huge_pages(tensor.data_ptr(),
                                 static_cast<size_t>(tensor.numel() * tensor.element_size()));  // NumPy does by itself
  return tensor;
}

// A (batch or 1, count) tensor of parameters as doubles.
struct Parameters {
  std::vector<double> values;
  int64_t stride = 0;

  Parameters() = default;
  Parameters(const Tensor& tensor, int64_t batch, int64_t count, const char* name, const char* op) {
    STD_TORCH_CHECK(tensor.is_cpu(), op, "(): expected ", name, " on the CPU, like image");
    const Tensor flat = torch::stable::contiguous(tensor);
    STD_TORCH_CHECK((flat.size(0) == batch || flat.size(0) == 1) && flat.numel() == flat.size(0) * count, op,
                    "(): expected ", name, " to hold ", count, " numbers for each of ", batch, " images, got shape ",
                    text(sizes_of(tensor)));
    values.resize(static_cast<size_t>(flat.numel()));
    if (flat.scalar_type() == DType::Double) {
      const double* data = static_cast<const double*>(flat.const_data_ptr());
      values.assign(data, data + values.size());
    } else {
      STD_TORCH_CHECK(flat.scalar_type() == DType::Float, op, "(): expected ", name, " in float32 or float64");
      const float* data = static_cast<const float*>(flat.const_data_ptr());
      values.assign(data, data + values.size());
    }
    stride = flat.size(0) == 1 ? 0 : count;
  }
};

fisheyerec::CameraModel camera_model(const std::string& name, const char* op) {
  int32_t model = 0;
  for (const char* known : fisheyerec::camera_model_names) {
    if (name == known) return static_cast<fisheyerec::CameraModel>(model);
    ++model;
  }
  STD_TORCH_CHECK(false, op, "(): expected a camera model such as pinhole or kannala_brandt, got ", name);
  return {};
}

// The arguments that forward and backward share, checked once.
struct Call {
  Parameters source, target, rotation;
  fisheyerec::Resampling resampling;

  Call(const char* op, const Tensor& image, const Tensor& source_params, const Tensor& target_params,
       const std::optional<Tensor>& source_from_target, const std::string& source_model,
       const std::string& target_model, const std::string& interpolation, const std::string& padding) {
    STD_TORCH_CHECK(image.is_cpu() && image.dim() == 4, op, "(): expected image (B, C, H, W) on the CPU, got shape ",
                    text(sizes_of(image)));
    STD_TORCH_CHECK(image.size(2) > 0 && image.size(3) > 0, op, "(): expected an image with pixels, got shape ",
                    text(sizes_of(image)));
    STD_TORCH_CHECK(image.size(2) <= fisheyerec::max_size && image.size(3) <= fisheyerec::max_size, op,
                    "(): expected height and width up to 2^30, got shape ", text(sizes_of(image)));
    STD_TORCH_CHECK(interpolation == "bilinear" || interpolation == "nearest", op,
                    "(): expected interpolation bilinear or nearest, got ", interpolation);
    STD_TORCH_CHECK(padding == "zeros" || padding == "border", op, "(): expected padding zeros or border, got ",
                    padding);
    const bool nearest = interpolation == "nearest";
    const fisheyerec::ScalarType type = scalar_type(image, op);
    STD_TORCH_CHECK(nearest || is_floating(type) || image.scalar_type() == DType::Byte, op,
                    "(): bilinear expects a floating or uint8 image; use nearest for labels");
    const int64_t batch = image.size(0);
    resampling.source.model = camera_model(source_model, op);
    resampling.target.model = camera_model(target_model, op);
    source = Parameters(source_params, batch, parameter_count(resampling.source.model), "source", op);
    target = Parameters(target_params, batch, parameter_count(resampling.target.model), "target", op);
    resampling.source.params = source.values.data();
    resampling.source.stride = source.stride;
    resampling.target.params = target.values.data();
    resampling.target.stride = target.stride;
    resampling.source_from_target = nullptr;
    resampling.rotation_stride = 0;
    if (source_from_target.has_value()) {
      rotation = Parameters(*source_from_target, batch, 9, "source_from_target", op);
      resampling.source_from_target = rotation.values.data();
      resampling.rotation_stride = rotation.stride;
    }
    resampling.interpolation = nearest ? fisheyerec::Interpolation::nearest : fisheyerec::Interpolation::bilinear;
    resampling.padding = padding == "zeros" ? fisheyerec::Padding::zeros : fisheyerec::Padding::border;
    resampling.threads = static_cast<int>(torch::stable::get_num_threads());
  }

  Call(const Call&) = delete;  // resampling points into this object
  Call& operator=(const Call&) = delete;
};

MemoryFormat memory_format(const Tensor& image) {
  const bool channels_last = image.stride(1) == 1 && image.size(1) > 1 && !image.is_contiguous();
  return channels_last ? MemoryFormat::ChannelsLast : MemoryFormat::Contiguous;
}

std::tuple<Tensor, Tensor> resample(Tensor image, Tensor source, Tensor target,
                                    std::optional<Tensor> source_from_target, std::string source_model,
                                    std::string target_model, int64_t height, int64_t width, std::string interpolation,
                                    std::string padding) {
  const char* op = "fisheyerec::resample";
  const Call call(op, image, source, target, source_from_target, source_model, target_model, interpolation, padding);
  STD_TORCH_CHECK(height > 0 && width > 0 && height <= fisheyerec::max_size && width <= fisheyerec::max_size, op,
                  "(): expected height and width in [1, 2^30], got ", height, " and ", width);
  Tensor out = empty({image.size(0), image.size(1), height, width}, image.scalar_type(), memory_format(image));
  Tensor valid = empty({image.size(0), 1, height, width}, DType::Bool);
  fisheyerec::resample(call.resampling, as_image(image, op), as_image(out, op),
                       static_cast<uint8_t*>(valid.data_ptr()));
  return {out, valid};
}

// Writes per-image gradients (batch, count) into a tensor shaped like `params`, summed where params repeat.
Tensor parameter_gradient(const Tensor& params, const std::vector<double>& values, int64_t count) {
  std::vector<int64_t> shape = sizes_of(params);
  Tensor out = empty(shape, params.scalar_type());
  std::vector<double> sums(static_cast<size_t>(out.numel()), 0.0);
  for (size_t i = 0; i < values.size(); ++i) {
    sums[params.size(0) == 1 ? i % static_cast<size_t>(count) : i] += values[i];
  }
  for (size_t i = 0; i < sums.size(); ++i) {
    if (params.scalar_type() == DType::Double) {
      static_cast<double*>(out.data_ptr())[i] = sums[i];
    } else {
      static_cast<float*>(out.data_ptr())[i] = static_cast<float>(sums[i]);
    }
  }
  return out;
}

// Gradients that nobody asked for come back empty, of shape (0,).
std::tuple<Tensor, Tensor, Tensor, Tensor> resample_backward(Tensor grad, Tensor image, Tensor source, Tensor target,
                                                             std::optional<Tensor> source_from_target,
                                                             std::string source_model, std::string target_model,
                                                             std::string interpolation, std::string padding,
                                                             bool need_image, bool need_source, bool need_target,
                                                             bool need_rotation) {
  const char* op = "fisheyerec::resample_backward";
  const Call call(op, image, source, target, source_from_target, source_model, target_model, interpolation, padding);
  const DType dtype = image.scalar_type();
  const int64_t batch = image.size(0);
  // A gradient of another shape or type than the forward's output would be read out of bounds.
  STD_TORCH_CHECK(grad.is_cpu() && grad.scalar_type() == dtype && grad.dim() == 4 && grad.size(0) == batch &&
                      grad.size(1) == image.size(1) && grad.size(2) > 0 && grad.size(3) > 0,
                  op, "(): expected grad of image's dtype, batch and channels, got shape ", text(sizes_of(grad)));
  STD_TORCH_CHECK(is_floating(scalar_type(image, op)), op, "(): expected a floating image");
  STD_TORCH_CHECK(!need_rotation || source_from_target.has_value(), op, "(): no rotation to give a gradient for");

  // Kernels want the layout of forward's output; autograd may send an expanded or a transposed gradient.
  grad = torch::stable::contiguous(grad, memory_format(image));

  // float16 and bfloat16 gradients are summed in float32, as thousands of small terms meet in one pixel.
  const DType sum_dtype = dtype == DType::Double ? DType::Double : DType::Float;
  Tensor grad_image = need_image ? empty(sizes_of(image), sum_dtype, memory_format(image)) : empty({0}, dtype);
  const int64_t source_count = parameter_count(call.resampling.source.model);
  const int64_t target_count = parameter_count(call.resampling.target.model);
  std::vector<double> grad_source(need_source ? static_cast<size_t>(batch * source_count) : 0);
  std::vector<double> grad_target(need_target ? static_cast<size_t>(batch * target_count) : 0);
  std::vector<double> grad_rotation(need_rotation ? static_cast<size_t>(batch * 9) : 0);
  fisheyerec::Image grad_image_view;
  if (need_image) grad_image_view = as_image(grad_image, op);
  const auto pointer = [](bool needed, std::vector<double>& values) { return needed ? values.data() : nullptr; };
  fisheyerec::resample_backward(call.resampling, as_image(image, op), as_image(grad, op),
                                {need_image ? &grad_image_view : nullptr, pointer(need_source, grad_source),
                                 pointer(need_target, grad_target), pointer(need_rotation, grad_rotation)});
  if (need_image && sum_dtype != dtype) grad_image = torch::stable::to(grad_image, dtype);
  return {grad_image,
          need_source ? parameter_gradient(source, grad_source, source_count) : empty({0}, source.scalar_type()),
          need_target ? parameter_gradient(target, grad_target, target_count) : empty({0}, target.scalar_type()),
          need_rotation ? parameter_gradient(*source_from_target, grad_rotation, 9) : empty({0}, dtype)};
}

}  // namespace

STABLE_TORCH_LIBRARY(fisheyerec, m) {
  m.def(
      "resample(Tensor image, Tensor source, Tensor target, Tensor? source_from_target, str source_model, "
      "str target_model, SymInt height, SymInt width, str interpolation, str padding) -> (Tensor, Tensor)");
  m.def(
      "resample_backward(Tensor grad, Tensor image, Tensor source, Tensor target, Tensor? source_from_target, "
      "str source_model, str target_model, str interpolation, str padding, bool need_image, bool need_source, "
      "bool need_target, bool need_rotation) -> (Tensor, Tensor, Tensor, Tensor)");
}

STABLE_TORCH_LIBRARY_IMPL(fisheyerec, CPU, m) {
  m.impl("resample", TORCH_BOX(&resample));
  m.impl("resample_backward", TORCH_BOX(&resample_backward));
}
