// The public face of tier 2: resample an image from one camera into another, and its adjoint.
//
// Every function writes all of its output, allocates nothing proportional to an image, and gives the same bits for
// any number of threads. Callers guarantee that shapes match and that pointers cover what the strides reach. A source
// may have any strides. A target (and its gradient) has pixels side by side, stride_x = 1; or, where the source is
// interleaved, channels side by side, stride_channel = 1.
#pragma once

#include <memory>

#include "image.h"

namespace fisheyerec {

enum class CameraModel : int32_t { pinhole, kannala_brandt, cylindrical, equirectangular, stereographic, panini };
enum class Interpolation : int32_t { nearest, bilinear };
enum class Padding : int32_t { zeros, border };

// Their names in that order, by which the doors of tier 3 are asked for them.
constexpr const char* camera_model_names[] = {"pinhole",         "kannala_brandt", "cylindrical",
                                              "equirectangular", "stereographic",  "panini"};

constexpr int parameter_count(CameraModel model) {
  switch (model) {
    case CameraModel::kannala_brandt: return 8;
    case CameraModel::panini: return 5;
    default: return 4;
  }
}

// One camera per image of the batch; stride 0 repeats one camera for all.
struct Cameras {
  CameraModel model;
  const double* params;
  int64_t stride;
};

struct Resampling {
  Cameras source, target;
  const double* source_from_target;  // row-major 3x3 rotations, or null
  int64_t rotation_stride;           // 9, or 0 to repeat one rotation
  Interpolation interpolation;
  Padding padding;
  int threads;
};

// target = source seen through the target camera. valid (batch, height, width) is 1 where the target pixel's ray
// meets the source image within the source lens' monotonic range. Nearest takes any type; bilinear all but int16 to
// int64.
void resample(const Resampling& resampling, const Image& source, const Image& target, uint8_t* valid);

template <class T>
struct KeptRun;

// The same cameras for picture after picture: keeps where each target pixel lies in the source, 8 bytes a pixel.
class Plan {
 public:
  // For cameras of one image. What resampling points to is read now and not kept.
  Plan(const Resampling& resampling, int64_t source_height, int64_t source_width, int64_t height, int64_t width);
  ~Plan();
  Plan(const Plan&) = delete;
  Plan& operator=(const Plan&) = delete;

  // What resample() gives for each image of the batch, to the bit; any type but float64. Several threads may call it
  // at once.
  void resample(const Image& source, const Image& target, Interpolation interpolation, int threads) const;

  // (height, width), as resample() gives it.
  const uint8_t* valid() const { return valid_.get(); }

 private:
  Padding padding_;
  std::unique_ptr<KeptRun<float>[]> kept_;
  std::unique_ptr<uint8_t[]> valid_;
};

// Outgoing gradients of one backward call; null where nobody asked.
struct Gradients {
  const Image* source;         // the source image's shape and layout, float64 for a float64 source, else float32
  double* source_params;       // (batch, parameter_count)
  double* target_params;       // (batch, parameter_count)
  double* source_from_target;  // (batch, 9)
};

void resample_backward(const Resampling& resampling, const Image& source, const Image& grad_target,
                       const Gradients& gradients);

// Points through a single camera, in double: rays (count, 3) to pixels (count, 2) and back, valid (count).
void project(const Cameras& camera, const double* rays, int64_t count, double* pixels, uint8_t* valid);
void unproject(const Cameras& camera, const double* pixels, int64_t count, double* rays, uint8_t* valid);

// The largest theta that a Kannala-Brandt lens with these k1..k4 maps without folding.
double kannala_brandt_theta_max(const double k[4]);

}  // namespace fisheyerec
