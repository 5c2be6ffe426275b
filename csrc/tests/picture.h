// Images that own exactly the memory their strides reach, so that AddressSanitizer sees every step beside it.
#pragma once

#include <algorithm>
#include <cstring>
#include <memory>
#include <utility>

#include "../kernels/image.h"
#include "../kernels/storage.h"

namespace fisheyerec {

inline int64_t bytes_of(ScalarType type) {
  switch (type) {
    case ScalarType::uint8: return 1;
    case ScalarType::uint16:
    case ScalarType::int16:
    case ScalarType::float16:
    case ScalarType::bfloat16: return 2;
    case ScalarType::int32:
    case ScalarType::float32: return 4;
    case ScalarType::int64:
    case ScalarType::float64: return 8;
  }
  return 0;
}

struct Shape {
  int64_t batch, channels, height, width;

  int64_t count() const { return batch * channels * height * width; }
};

struct Strides {
  int64_t batch, channel, y, x;
};

inline Strides planar(const Shape& s) { return {s.channels * s.height * s.width, s.height * s.width, s.width, 1}; }
inline Strides interleaved(const Shape& s) {
  return {s.channels * s.height * s.width, 1, s.width * s.channels, s.channels};
}

class Picture {
 public:
  Image image;

  Picture(ScalarType type, const Shape& shape, const Strides& strides)
      : image{nullptr,     type,          shape.batch,     shape.channels, shape.height,
              shape.width, strides.batch, strides.channel, strides.y,      strides.x} {
    int64_t lowest = 0, highest = 0;  // offsets from the first pixel
    for (const auto& [size, stride] : {std::pair{shape.batch, strides.batch},
                                       {shape.channels, strides.channel},
                                       {shape.height, strides.y},
                                       {shape.width, strides.x}}) {
      if (size > 1) (stride < 0 ? lowest : highest) += (size - 1) * stride;
    }
    byte_count_ = shape.count() > 0 ? (highest - lowest + 1) * bytes_of(type) : 0;
    bytes_.reset(new unsigned char[static_cast<size_t>(byte_count_)]());
    image.data = bytes_.get() - lowest * bytes_of(type);
  }
  Picture(ScalarType type, const Shape& shape) : Picture(type, shape, planar(shape)) {}

  unsigned char* bytes() const { return bytes_.get(); }
  size_t byte_count() const { return static_cast<size_t>(byte_count_); }
  void fill_bytes(int byte) const { std::memset(bytes(), byte, byte_count()); }

  void* at(int64_t b, int64_t c, int64_t y, int64_t x) const {
    const int64_t offset = b * image.stride_batch + c * image.stride_channel + y * image.stride_y + x * image.stride_x;
    return static_cast<unsigned char*>(image.data) + offset * bytes_of(image.type);
  }

  double get(int64_t b, int64_t c, int64_t y, int64_t x) const {
    switch (image.type) {
      case ScalarType::uint8: return read<uint8_t>(at(b, c, y, x));
      case ScalarType::uint16: return read<uint16_t>(at(b, c, y, x));
      case ScalarType::int16: return read<int16_t>(at(b, c, y, x));
      case ScalarType::int32: return read<int32_t>(at(b, c, y, x));
      case ScalarType::int64: return static_cast<double>(read<int64_t>(at(b, c, y, x)));
      case ScalarType::float16: return Storage<Float16>::widen<float>(read<uint16_t>(at(b, c, y, x)));
      case ScalarType::bfloat16: return Storage<BFloat16>::widen<float>(read<uint16_t>(at(b, c, y, x)));
      case ScalarType::float32: return read<float>(at(b, c, y, x));
      case ScalarType::float64: return read<double>(at(b, c, y, x));
    }
    return 0;
  }

  void set(int64_t b, int64_t c, int64_t y, int64_t x, double value) const {
    void* pixel = at(b, c, y, x);
    switch (image.type) {
      case ScalarType::uint8: return write(pixel, static_cast<uint8_t>(value));
      case ScalarType::uint16: return write(pixel, static_cast<uint16_t>(value));
      case ScalarType::int16: return write(pixel, static_cast<int16_t>(value));
      case ScalarType::int32: return write(pixel, static_cast<int32_t>(value));
      case ScalarType::int64: return write(pixel, static_cast<int64_t>(value));
      case ScalarType::float16: return write(pixel, Storage<Float16>::narrow<float>(static_cast<float>(value)));
      case ScalarType::bfloat16: return write(pixel, Storage<BFloat16>::narrow<float>(static_cast<float>(value)));
      case ScalarType::float32: return write(pixel, static_cast<float>(value));
      case ScalarType::float64: return write(pixel, value);
    }
  }

  // visit(batch, channel, y, x)
  template <class Visit>
  void for_each(const Visit& visit) const {
    for (int64_t b = 0; b < image.batch; ++b) {
      for (int64_t c = 0; c < image.channels; ++c) {
        for (int64_t y = 0; y < image.height; ++y) {
          for (int64_t x = 0; x < image.width; ++x) visit(b, c, y, x);
        }
      }
    }
  }

  // value(batch, channel, y, x)
  template <class Value>
  const Picture& fill(const Value& value) const {
    for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) { set(b, c, y, x, value(b, c, y, x)); });
    return *this;
  }

 private:
  template <class D>
  static D read(const void* pixel) {
    D value;
    std::memcpy(&value, pixel, sizeof value);
    return value;
  }
  template <class D>
  static void write(void* pixel, D value) {
    std::memcpy(pixel, &value, sizeof value);
  }

  std::unique_ptr<unsigned char[]> bytes_;
  int64_t byte_count_;
};

}  // namespace fisheyerec
