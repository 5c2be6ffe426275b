// Random cameras, shapes and memory layouts, sane and insane, from fixed seeds. Buffers are exactly as long as the
// strides reach, so that AddressSanitizer proves that nothing beside an image is read or written; UBSan, that no
// number overflows an integer. Without sanitizers the test still proves that all of the output is written, nothing
// between its pixels is, and that the number of threads changes no bit.
#include <random>

#include "../kernels/resample.h"
#include "cameras.h"
#include "check.h"
#include "picture.h"

using namespace fisheyerec;

namespace {

class Random {
 public:
  explicit Random(uint64_t seed) : engine_(seed) {}

  int64_t integer(int64_t low, int64_t high) { return std::uniform_int_distribution<int64_t>(low, high)(engine_); }
  double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(engine_); }
  bool once_in(int64_t count) { return integer(1, count) == 1; }
  template <class T, size_t count>
  const T& pick(const T (&choices)[count]) {
    return choices[integer(0, count - 1)];
  }

  double extreme() {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    static const double values[] = {0,     -0.0,   1e-30,    -1e-30,    1e-300, 5e-324, 1e9,      -1e9,
                                    3e9,   1e19,   3.4e38,   -3.4e38,   1e30,   -1e30,  1e200,    -1e200,
                                    1e308, -1e308, infinity, -infinity, 0.5,    -1,     16777217, std::nan("")};
    return pick(values);
  }

 private:
  std::mt19937_64 engine_;
};

// Most often those that are used most.
constexpr CameraModel models[] = {
    CameraModel::pinhole,     CameraModel::kannala_brandt,  CameraModel::pinhole,       CameraModel::kannala_brandt,
    CameraModel::cylindrical, CameraModel::equirectangular, CameraModel::stereographic, CameraModel::panini};

// Half of the time sane, else with a few extremes among the numbers.
void fill_params(Random& random, CameraModel model, const Shape& shape, double* params) {
  const double focal = std::exp2(random.uniform(-2, 10));
  const double sane[4] = {focal, focal * random.uniform(0.9, 1.1), static_cast<double>(shape.width - 1) / 2,
                          static_cast<double>(shape.height - 1) / 2};
  std::copy(sane, sane + 4, params);
  const int count = parameter_count(model);
  if (model == CameraModel::kannala_brandt) {
    const double* k = random.pick(cameras).params + 4;
    for (int i = 0; i < 4; ++i) params[4 + i] = random.once_in(3) ? random.uniform(-2, 2) : k[i];
  }
  if (model == CameraModel::panini) params[4] = random.uniform(0, 1.5);
  if (random.once_in(2)) {
    for (int64_t times = random.integer(1, 3); times > 0; --times)
      params[random.integer(0, count - 1)] = random.extreme();
  }
}

void fill_rotation(Random& random, double* R) {
  const double a = random.uniform(-4, 4), b = random.once_in(3) ? random.uniform(-4, 4) : 0;
  const double values[9] = {std::cos(a),
                            -std::sin(a) * std::cos(b),
                            std::sin(a) * std::sin(b),
                            std::sin(a),
                            std::cos(a) * std::cos(b),
                            -std::cos(a) * std::sin(b),
                            0,
                            std::sin(b),
                            std::cos(b)};
  std::copy(values, values + 9, R);
  if (random.once_in(4)) R[random.integer(0, 8)] = random.extreme();
}

enum Axis { batch_axis, channel_axis, y_axis, x_axis, any_axis };

// The axes in any order, gaps between them, any of them backwards; only the axis `dense` has stride 1. Where
// `repeats`, axes may also have stride 0.
Strides random_strides(Random& random, const Shape& shape, Axis dense, bool repeats) {
  const int64_t sizes[4] = {shape.batch, shape.channels, shape.height, shape.width};
  int order[4] = {x_axis, y_axis, channel_axis, batch_axis};
  if (!random.once_in(3)) {
    for (int i = 3; i > 0; --i) std::swap(order[i], order[random.integer(0, i)]);
  }
  if (dense != any_axis) std::swap(order[0], *std::find(order, order + 4, dense));
  int64_t strides[4], reach = 1;
  for (const int axis : order) {
    strides[axis] = reach + (axis != dense && random.once_in(4) ? random.integer(0, 5) : 0);
    reach = strides[axis] * std::max<int64_t>(1, sizes[axis]);
    if (axis != dense && random.once_in(5)) strides[axis] = -strides[axis];
    if (axis != dense && repeats && random.once_in(8)) strides[axis] = 0;
    // The stride of an axis of one element means nothing, and some libraries write anything there.
    if (sizes[axis] <= 1 && random.once_in(2)) {
      strides[axis] = random.pick({int64_t{0}, int64_t{1}, int64_t{-7}, int64_t{1} << 40});
    }
  }
  return {strides[0], strides[1], strides[2], strides[3]};
}

// What resample.h asks of a target: pixels side by side, or channels as in the source.
Axis target_axis(Random& random, const Picture& source) {
  return source.image.interleaved() && !random.once_in(3) ? channel_axis : x_axis;
}

int64_t random_side(Random& random) {
  if (random.once_in(6)) return 1;
  if (random.once_in(12)) return random.integer(250, 530);  // around the kernels' run length
  return random.integer(1, 24);
}

void fill_pixels(Random& random, const Picture& picture) {
  const bool with_extremes = random.once_in(4);
  for (size_t i = 0; i < picture.byte_count(); ++i) picture.bytes()[i] = static_cast<unsigned char>(i * 37);
  if (picture.image.type == ScalarType::uint8 || picture.image.type == ScalarType::uint16) return;
  picture.for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) {
    const bool whole = picture.image.type == ScalarType::int16 || picture.image.type == ScalarType::int32 ||
                       picture.image.type == ScalarType::int64;
    picture.set(b, c, y, x,
                with_extremes && !whole && random.once_in(50) ? random.extreme() : random.uniform(-100, 100));
  });
}

// Sets the bytes of pixels to zero, so that what is left of the filling lies between them.
void blank_pixels(const Picture& picture) {
  picture.for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) {
    std::memset(picture.at(b, c, y, x), 0, static_cast<size_t>(bytes_of(picture.image.type)));
  });
}

bool same_pixels(const Picture& a, const Picture& b) {
  bool same = true;
  a.for_each([&](int64_t i, int64_t c, int64_t y, int64_t x) {
    const bool both_nan = std::isnan(a.get(i, c, y, x)) && std::isnan(b.get(i, c, y, x));  // of any payload
    same = same && (both_nan ||
                    std::memcmp(a.at(i, c, y, x), b.at(i, c, y, x), static_cast<size_t>(bytes_of(a.image.type))) == 0);
  });
  return same;
}

bool untouched_between_pixels(const Picture& picture, unsigned char filling) {
  blank_pixels(picture);
  Picture expected(
      picture.image.type, {picture.image.batch, picture.image.channels, picture.image.height, picture.image.width},
      {picture.image.stride_batch, picture.image.stride_channel, picture.image.stride_y, picture.image.stride_x});
  expected.fill_bytes(filling);
  blank_pixels(expected);
  return std::memcmp(picture.bytes(), expected.bytes(), picture.byte_count()) == 0;
}

struct Case {
  Resampling resampling;
  Shape source_shape, target_shape;
  ScalarType type;
  std::vector<double> source_params, target_params, rotations;

  explicit Case(Random& random) {
    int64_t batch, channels;
    do {  // a picture that takes long teaches nothing more
      batch = random.integer(1, 3), channels = random.once_in(3) ? random.integer(1, 20) : random.integer(1, 4);
      source_shape = {batch, channels, random_side(random), random_side(random)};
      target_shape = {batch, channels, random_side(random), random_side(random)};
    } while (source_shape.count() + target_shape.count() > 20000);
    if (random.once_in(30)) target_shape.height = 30, target_shape.width = 570;  // enough for several threads
    if (random.once_in(30)) target_shape.height = 0;
    resampling.source.model = random.pick(models), resampling.target.model = random.pick(models);
    const auto fill = [&](Cameras& camera, const Shape& shape, std::vector<double>& params) {
      const int count = parameter_count(camera.model);
      camera.stride = random.once_in(3) ? 0 : count;
      const int64_t cameras_count = camera.stride ? batch : 1;
      params.resize(static_cast<size_t>(cameras_count * count));
      for (int64_t b = 0; b < cameras_count; ++b) fill_params(random, camera.model, shape, params.data() + b * count);
      camera.params = params.data();
    };
    fill(resampling.source, source_shape, source_params);
    fill(resampling.target, target_shape, target_params);
    resampling.source_from_target = nullptr;
    resampling.rotation_stride = random.once_in(2) ? 0 : 9;
    if (random.once_in(2)) {
      rotations.resize(static_cast<size_t>(resampling.rotation_stride ? 9 * batch : 9));
      for (size_t i = 0; i < rotations.size(); i += 9) fill_rotation(random, rotations.data() + i);
      resampling.source_from_target = rotations.data();
    }
    const Interpolation interpolations[] = {Interpolation::nearest, Interpolation::bilinear, Interpolation::bilinear};
    const Padding paddings[] = {Padding::zeros, Padding::border};
    resampling.interpolation = random.pick(interpolations), resampling.padding = random.pick(paddings);
    resampling.threads = 1;
    const ScalarType any[] = {ScalarType::uint8,    ScalarType::uint16,  ScalarType::int16,
                              ScalarType::int32,    ScalarType::int64,   ScalarType::float16,
                              ScalarType::bfloat16, ScalarType::float32, ScalarType::float64};
    const ScalarType blended[] = {ScalarType::uint8,    ScalarType::uint16,  ScalarType::float16,
                                  ScalarType::bfloat16, ScalarType::float32, ScalarType::float64};
    type = resampling.interpolation == Interpolation::nearest ? random.pick(any) : random.pick(blended);
  }
  Case(const Case&) = delete;
};

void check_forward(Random& random, Case& c, const Picture& source) {
  const Strides strides = random_strides(random, c.target_shape, target_axis(random, source), false);
  const Picture first(c.type, c.target_shape, strides), second(c.type, c.target_shape, strides);
  first.fill_bytes(0x00), second.fill_bytes(0xab);
  const auto count = static_cast<size_t>(c.target_shape.batch * c.target_shape.height * c.target_shape.width);
  std::vector<uint8_t> first_valid(count, 7), second_valid(count, 9);
  c.resampling.threads = 1;
  resample(c.resampling, source.image, first.image, first_valid.data());
  c.resampling.threads = 3;
  resample(c.resampling, source.image, second.image, second_valid.data());
  CHECK(same_pixels(first, second));
  CHECK(first_valid == second_valid);
  for (const uint8_t valid : first_valid) CHECK(valid <= 1);
  CHECK(untouched_between_pixels(second, 0xab));
}

void check_backward(Random& random, Case& c, const Picture& source) {
  const Picture grad_target(c.type, c.target_shape,
                            random_strides(random, c.target_shape, target_axis(random, source), true));
  fill_pixels(random, grad_target);
  const Axis dense = source.image.interleaved() && grad_target.image.interleaved() ? channel_axis : any_axis;
  const Strides strides = random_strides(random, c.source_shape, dense, false);
  const ScalarType type = c.type == ScalarType::float64 ? c.type : ScalarType::float32;
  const Picture first(type, c.source_shape, strides), second(type, c.source_shape, strides);
  first.fill_bytes(0x00), second.fill_bytes(0xab);
  const bool wants[4] = {!random.once_in(4), !random.once_in(4), !random.once_in(4), !random.once_in(4)};
  const auto batch = static_cast<size_t>(c.target_shape.batch);
  const auto source_count = batch * static_cast<size_t>(parameter_count(c.resampling.source.model));
  const auto target_count = batch * static_cast<size_t>(parameter_count(c.resampling.target.model));
  std::vector<double> params[2][3];
  for (int run = 0; run < 2; ++run) {
    std::vector<double>* p = params[run];
    p[0].assign(source_count, run), p[1].assign(target_count, run), p[2].assign(9 * batch, run);
    c.resampling.threads = run ? 3 : 1;
    resample_backward(c.resampling, source.image, grad_target.image,
                      {wants[0] ? &(run ? second : first).image : nullptr, wants[1] ? p[0].data() : nullptr,
                       wants[2] ? p[1].data() : nullptr, wants[3] ? p[2].data() : nullptr});
  }
  if (wants[0]) {
    CHECK(same_pixels(first, second));
    CHECK(untouched_between_pixels(second, 0xab));
  }
  for (int i = 0; i < 3; ++i) {
    if (!wants[1 + i]) continue;
    CHECK(std::equal(params[0][i].begin(), params[0][i].end(), params[1][i].begin(),
                     [](double a, double b) { return a == b || (std::isnan(a) && std::isnan(b)); }));
  }
}

}  // namespace

TEST(anything_goes_in_and_nothing_breaks) {
  constexpr uint64_t seeds = 1500;
  for (uint64_t seed = 0; seed < seeds; ++seed) {
    char name[32];
    std::snprintf(name, sizeof name, "seed %d", static_cast<int>(seed));
    check::subject = name;
    Random random(seed);
    Case c(random);
    const Axis dense = random.once_in(2) ? any_axis : random.once_in(2) ? x_axis : channel_axis;
    const Picture source(c.type, c.source_shape, random_strides(random, c.source_shape, dense, true));
    fill_pixels(random, source);
    check_forward(random, c, source);
    const bool blended = c.type == ScalarType::float16 || c.type == ScalarType::bfloat16 ||
                         c.type == ScalarType::float32 || c.type == ScalarType::float64;
    if (blended) check_backward(random, c, source);
  }
}

TEST(points_of_any_size_go_in) {
  Random random(1);
  for (int repeat = 0; repeat < 20000; ++repeat) {
    double params[8] = {};
    const CameraModel model = random.pick(models);
    fill_params(random, model, {1, 1, 480, 640}, params);
    double pixel[2] = {random.uniform(0, 640), random.uniform(0, 480)}, ray[3] = {1, 2, 3}, out[3];
    if (random.once_in(2)) pixel[0] = random.extreme(), ray[random.integer(0, 2)] = random.extreme();
    uint8_t valid = 7;
    project({model, params, 0}, ray, 1, out, &valid);
    CHECK(valid <= 1 && (valid == 0) == std::isnan(out[0]));
    unproject({model, params, 0}, pixel, 1, out, &valid);
    CHECK(valid <= 1 && (valid == 0) == std::isnan(out[0]));
    kannala_brandt_theta_max(params + 4);
  }
}
