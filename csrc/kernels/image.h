// Strided images over raw memory: what tier 3 hands to the kernels.
#pragma once

#include <cstdint>

#include "../geometry/lanes.h"

namespace fisheyerec {

enum class ScalarType : int32_t { uint8, uint16, int16, int32, int64, float16, bfloat16, float32, float64 };

// The largest height and width: indices, and floats near them, stay within 32 bits.
constexpr int64_t max_size = int64_t{1} << 30;

// A (batch, channels, height, width) image. Strides count elements and may be negative or, for the batch, zero.
struct Image {
  void* data;
  ScalarType type;
  int64_t batch, channels, height, width;
  int64_t stride_batch, stride_channel, stride_y, stride_x;

  // Channels of one pixel side by side (channels_last, HWC), so that loops run over channels.
  FISHEYEREC_INLINE bool interleaved() const { return stride_channel == 1 && channels > 1; }
};

}  // namespace fisheyerec
