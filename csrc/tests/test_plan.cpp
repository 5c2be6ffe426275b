#include <thread>
#include <vector>

#include "../kernels/resample.h"
#include "check.h"
#include "picture.h"

using namespace fisheyerec;

namespace {

const double lens[8] = {60, 62, 40.3, 29.8, 0.05, -0.02, 0.01, -0.003};
const double view[4] = {55, 56, 147.2, 31.1};
const double turned[9] = {0.98006658,  0,           0.19866933, 0.01986693, 0.99498744,
                          -0.09800666, -0.19767681, 0.09999983, 0.97515388};
const Shape source_shape{2, 3, 61, 83}, target_shape{2, 3, 47, 300};  // a target of more than one run, not a multiple

Resampling rectify(const double* rotation, Padding padding, Interpolation interpolation, int threads) {
  return {{CameraModel::kannala_brandt, lens, 0},
          {CameraModel::pinhole, view, 0},
          rotation,
          0,
          interpolation,
          padding,
          threads};
}

Picture noise(ScalarType type, const Strides& strides) {
  Picture picture(type, source_shape, strides);
  picture.fill([](int64_t b, int64_t c, int64_t y, int64_t x) {
    return static_cast<double>((7 * x + 13 * y + 29 * c + 53 * b + x * y) % 200);
  });
  return picture;
}

bool same_bytes(const Picture& a, const Picture& b) { return std::memcmp(a.bytes(), b.bytes(), a.byte_count()) == 0; }

Plan plan_for(const Resampling& resampling) {
  return Plan(resampling, source_shape.height, source_shape.width, target_shape.height, target_shape.width);
}

}  // namespace

TEST(a_plan_gives_what_resample_gives) {
  for (const double* rotation : {static_cast<const double*>(nullptr), turned}) {
    for (const Padding padding : {Padding::zeros, Padding::border}) {
      const Plan plan = plan_for(rectify(rotation, padding, Interpolation::bilinear, 2));
      for (const ScalarType type : {ScalarType::uint8, ScalarType::float16, ScalarType::float32, ScalarType::int64}) {
        for (const bool dense : {false, true}) {
          const auto strides = [dense](const Shape& shape) { return dense ? interleaved(shape) : planar(shape); };
          const Picture source = noise(type, strides(source_shape));
          const Picture expected(type, target_shape, strides(target_shape));
          const Picture planned(type, target_shape, strides(target_shape));
          for (const Interpolation interpolation : {Interpolation::nearest, Interpolation::bilinear}) {
            if (type == ScalarType::int64 && interpolation == Interpolation::bilinear) continue;
            std::vector<uint8_t> valid(2 * 47 * 300);
            resample(rectify(rotation, padding, interpolation, 1), source.image, expected.image, valid.data());
            planned.fill_bytes(0xee);
            plan.resample(source.image, planned.image, interpolation, 3);
            CHECK(same_bytes(planned, expected));
            CHECK(std::memcmp(plan.valid(), valid.data(), valid.size() / 2) == 0);
            CHECK(std::memchr(plan.valid(), 0, valid.size() / 2) && std::memchr(plan.valid(), 1, valid.size() / 2));
          }
        }
      }
    }
  }
}

TEST(a_plan_serves_several_threads_at_once) {
  const Plan plan = plan_for(rectify(nullptr, Padding::zeros, Interpolation::bilinear, 1));
  const Picture source = noise(ScalarType::uint8, interleaved(source_shape));
  const Picture expected(ScalarType::uint8, target_shape, interleaved(target_shape));
  plan.resample(source.image, expected.image, Interpolation::bilinear, 1);
  std::vector<Picture> outputs;
  for (int i = 0; i < 4; ++i) outputs.emplace_back(ScalarType::uint8, target_shape, interleaved(target_shape));
  std::vector<std::thread> threads;
  for (const Picture& out : outputs) {
    threads.emplace_back([&] { plan.resample(source.image, out.image, Interpolation::bilinear, 1); });
  }
  for (std::thread& thread : threads) thread.join();
  for (const Picture& out : outputs) CHECK(same_bytes(out, expected));
}

TEST(a_plan_of_a_lens_that_is_no_number_gives_zeros) {
  double broken[8];
  std::copy(lens, lens + 8, broken);
  broken[5] = std::numeric_limits<double>::quiet_NaN();
  Resampling resampling = rectify(nullptr, Padding::border, Interpolation::bilinear, 1);
  resampling.source.params = broken;
  const Plan plan = plan_for(resampling);
  const Picture source = noise(ScalarType::uint8, interleaved(source_shape));
  const Picture target(ScalarType::uint8, target_shape, interleaved(target_shape));
  target.fill_bytes(0xee);
  plan.resample(source.image, target.image, Interpolation::bilinear, 1);
  CHECK(target.get(0, 0, 0, 0) == 0 && target.get(1, 2, 46, 299) == 0);
  CHECK(std::memchr(plan.valid(), 1, 47 * 300) == nullptr);
}
