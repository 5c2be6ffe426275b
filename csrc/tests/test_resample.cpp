#include "../kernels/resample.h"

#include <random>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "cameras.h"
#include "check.h"
#include "derivative.h"
#include "picture.h"

using namespace fisheyerec;

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity(),
                 not_a_number = std::numeric_limits<double>::quiet_NaN();
constexpr Padding paddings[] = {Padding::zeros, Padding::border};
constexpr Interpolation interpolations[] = {Interpolation::nearest, Interpolation::bilinear};

const double lens[8] = {60, 62, 40.3, 29.8, 0.05, -0.02, 0.01, -0.003};
const double view[4] = {55, 56, 47.2, 31.1};
const double turned[9] = {0.98006658,  0,           0.19866933, 0.01986693, 0.99498744,
                          -0.09800666, -0.19767681, 0.09999983, 0.97515388};

Resampling rectify(const double* source = lens, const double* target = view) {
  return {{CameraModel::kannala_brandt, source, 0},
          {CameraModel::pinhole, target, 0},
          nullptr,
          0,
          Interpolation::bilinear,
          Padding::zeros,
          1};
}

// Target pixel (x, y) reads source pixel (x + shift_x, y + shift_y).
struct Shift {
  double source[4], target[4] = {1, 1, 0, 0};
  Resampling resampling;

  Shift(double shift_x, double shift_y, Interpolation interpolation, Padding padding = Padding::zeros)
      : source{1, 1, shift_x, shift_y}, resampling{{CameraModel::pinhole, source, 0},
                                                   {CameraModel::pinhole, target, 0},
                                                   nullptr,
                                                   0,
                                                   interpolation,
                                                   padding,
                                                   1} {}
};

double noise(int64_t b, int64_t c, int64_t y, int64_t x) {
  std::minstd_rand random(static_cast<unsigned>(1 + x + 1000 * y + 1000003 * c + 999979 * b));
  random.discard(3);
  return static_cast<double>(random() % 200 + 1);
}

ScalarType gradient_type(ScalarType type) { return type == ScalarType::float64 ? type : ScalarType::float32; }

struct Output {
  Picture target;
  std::vector<uint8_t> valid;
};

Output run(const Resampling& resampling, const Picture& source, const Shape& shape, const Strides& strides) {
  Output out{Picture(source.image.type, shape, strides),
             std::vector<uint8_t>(static_cast<size_t>(shape.batch * shape.height * shape.width), 0xee)};
  out.target.fill_bytes(0xee);
  resample(resampling, source.image, out.target.image, out.valid.data());
  return out;
}

Output run(const Resampling& resampling, const Picture& source, const Shape& shape) {
  return run(resampling, source, shape, planar(shape));
}

bool same(const Picture& a, const Picture& b) {
  bool equal = true;
  a.for_each(
      [&](int64_t i, int64_t c, int64_t y, int64_t x) { equal = equal && a.get(i, c, y, x) == b.get(i, c, y, x); });
  return equal;
}

struct ParameterGradients {
  std::vector<double> source, target, rotation;

  explicit ParameterGradients(const Resampling& resampling, int64_t batch)
      : source(static_cast<size_t>(batch * parameter_count(resampling.source.model)), not_a_number),
        target(static_cast<size_t>(batch * parameter_count(resampling.target.model)), not_a_number),
        rotation(static_cast<size_t>(batch * 9), not_a_number) {}

  Gradients with(const Picture* grad_source) {
    return {grad_source ? &grad_source->image : nullptr, source.data(), target.data(), rotation.data()};
  }
  bool operator==(const ParameterGradients& other) const {
    return source == other.source && target == other.target && rotation == other.rotation;
  }
};

double dot(const Picture& a, const Picture& b) {
  double sum = 0;
  a.for_each([&](int64_t i, int64_t c, int64_t y, int64_t x) { sum += a.get(i, c, y, x) * b.get(i, c, y, x); });
  return sum;
}

}  // namespace

TEST(the_same_camera_on_both_sides_returns_the_image) {
  const Shape shape{2, 3, 60, 80};
  for (const ScalarType type :
       {ScalarType::uint8, ScalarType::float16, ScalarType::bfloat16, ScalarType::float32, ScalarType::float64}) {
    const Picture source(type, shape);
    source.fill(noise);
    for (const Interpolation interpolation : interpolations) {
      Resampling resampling{{CameraModel::kannala_brandt, lens, 0},
                            {CameraModel::kannala_brandt, lens, 0},
                            nullptr,
                            0,
                            interpolation,
                            Padding::border,
                            1};
      const Output out = run(resampling, source, shape);
      // The coordinate's rounding times the steepest slope there is.
      const double tolerance = type == ScalarType::float64 ? 1e-10 : type == ScalarType::bfloat16 ? 1 : 0.1;
      out.target.for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) {
        CHECK_NEAR(out.target.get(b, c, y, x), source.get(b, c, y, x),
                   interpolation == Interpolation::nearest ? 0 : tolerance);
      });
    }
  }
}

TEST(a_shifted_principal_point_shifts_the_image_by_whole_pixels_and_frames_it) {
  const Shape shape{1, 2, 17, 300}, target_shape{1, 2, 20, 310};
  for (const ScalarType type :
       {ScalarType::uint8, ScalarType::uint16, ScalarType::int16, ScalarType::int32, ScalarType::int64,
        ScalarType::float16, ScalarType::bfloat16, ScalarType::float32, ScalarType::float64}) {
    const bool integer = type == ScalarType::int16 || type == ScalarType::int32 || type == ScalarType::int64;
    for (const Interpolation interpolation : interpolations) {
      if (integer && interpolation == Interpolation::bilinear) continue;
      for (const Padding padding : paddings) {
        for (const bool channels_last : {false, true}) {
          const Picture source(type, shape, channels_last ? interleaved(shape) : planar(shape));
          source.fill(noise);
          const Strides strides = channels_last ? interleaved(target_shape) : planar(target_shape);
          const Output out = run(Shift(-4, 3, interpolation, padding).resampling, source, target_shape, strides);
          out.target.for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) {
            const int64_t sx = x - 4, sy = y + 3;
            const bool seen = sx >= 0 && sx < shape.width && sy >= 0 && sy < shape.height;
            const int64_t nx = std::min(std::max(sx, int64_t{0}), shape.width - 1);
            const int64_t ny = std::min(std::max(sy, int64_t{0}), shape.height - 1);
            CHECK(out.target.get(b, c, y, x) == (seen || padding == Padding::border ? source.get(b, c, ny, nx) : 0));
            CHECK(out.valid[static_cast<size_t>(y * target_shape.width + x)] == seen);
          });
        }
      }
    }
  }
}

TEST(bilinear_weighs_the_four_neighbours) {
  const Shape shape{1, 1, 2, 2};
  const Picture source(ScalarType::float64, shape);
  source.fill(
      [](int64_t, int64_t, int64_t y, int64_t x) { return static_cast<double>(10 + 20 * y + 5 * x + 3 * x * y); });
  const Output inside = run(Shift(0.25, 0.75, Interpolation::bilinear).resampling, source, {1, 1, 1, 1});
  CHECK_NEAR(inside.target.get(0, 0, 0, 0), 10 + 15 + 1.25 + 3 * 0.25 * 0.75, 1e-14);
  const Output fading = run(Shift(-0.25, -0.5, Interpolation::bilinear).resampling, source, {1, 1, 1, 1});
  CHECK_NEAR(fading.target.get(0, 0, 0, 0), 10 * 0.75 * 0.5, 1e-14);
  CHECK(inside.valid[0] == 1 && fading.valid[0] == 1);
  const Output outside = run(Shift(-0.75, 0, Interpolation::bilinear).resampling, source, {1, 1, 1, 1});
  CHECK_NEAR(outside.target.get(0, 0, 0, 0), 2.5, 1e-14);
  CHECK(outside.valid[0] == 0);
}

// Against the four points of the geometry, composed by hand, for every camera of the table.
TEST(every_target_pixel_reads_where_its_ray_lands) {
  for (const NamedCamera& camera : cameras) {
    check::subject = camera.name;
    const double target[4] = {camera.width / 4.0, camera.width / 4.0, 31.5, 23.5};
    const Shape shape{1, 2, camera.height / 8, camera.width / 8}, target_shape{1, 2, 48, 64};
    double scaled[8];
    std::copy(camera.params, camera.params + 8, scaled);
    for (int i = 0; i < 4; ++i) scaled[i] /= 8;
    const Picture source(ScalarType::float64, shape);
    source.fill([](int64_t, int64_t c, int64_t y, int64_t x) { return static_cast<double>(c ? y : x); });
    const Resampling resampling = rectify(scaled, target);
    const Output out = run(resampling, source, target_shape);
    int seen = 0;
    for (int64_t y = 0; y < 48; ++y) {
      for (int64_t x = 0; x < 64; ++x) {
        const double pixel[2] = {static_cast<double>(x), static_cast<double>(y)};
        double ray[3], landing[2];
        uint8_t hit;
        unproject(resampling.target, pixel, 1, ray, &hit);
        project(resampling.source, ray, 1, landing, &hit);
        const double last_x = static_cast<double>(shape.width - 1), last_y = static_cast<double>(shape.height - 1);
        const bool valid =
            hit && landing[0] >= -0.5 && landing[0] <= last_x + 0.5 && landing[1] >= -0.5 && landing[1] <= last_y + 0.5;
        CHECK(out.valid[static_cast<size_t>(y * 64 + x)] == valid);
        if (!valid || landing[0] < 0 || landing[0] > last_x || landing[1] < 0 || landing[1] > last_y) continue;
        ++seen;
        CHECK_NEAR(out.target.get(0, 0, y, x), landing[0], 1e-9);
        CHECK_NEAR(out.target.get(0, 1, y, x), landing[1], 1e-9);
      }
    }
    CHECK(seen > 20);
  }
}

TEST(a_folded_lens_shows_nothing_twice) {
  const double folded[8] = {30, 30, 49.5, 49.5, -0.1, 0, 0, 0}, wide[4] = {5, 5, 49.5, 49.5};
  const double limit = kannala_brandt_theta_max(folded + 4);
  CHECK_NEAR(limit, std::sqrt(1 / 0.3), 1e-14);
  const Picture source(ScalarType::float32, {1, 1, 100, 100});
  source.fill([](int64_t, int64_t, int64_t, int64_t) { return 1.0; });
  const double facing_back[9] = {-1, 0, 0, 0, 1, 0, 0, 0, -1};
  Resampling resampling = rectify(folded, wide);
  CHECK(run(resampling, source, {1, 1, 100, 100}).valid[49 * 100 + 49] == 1);
  resampling.source_from_target = facing_back;
  const Output behind = run(resampling, source, {1, 1, 100, 100});
  for (int64_t y = 0; y < 100; ++y) {
    for (int64_t x = 0; x < 100; ++x) {
      const double px = static_cast<double>(x), py = static_cast<double>(y);
      const double theta = std::acos(-1.0) - std::atan(std::hypot(px - 49.5, py - 49.5) / 5);
      CHECK(behind.valid[static_cast<size_t>(100 * y + x)] == (theta <= limit));
    }
  }
}

// <A x, y> = <x, A' y>, for every direction, padding, interpolation, layout, and size down to one pixel.
TEST(the_image_gradient_is_the_adjoint) {
  const Shape source_shapes[] = {{2, 3, 60, 80}, {1, 1, 1, 1}, {1, 20, 7, 1}, {2, 2, 1, 90}};
  const Shape target_shapes[] = {{2, 3, 64, 300}, {1, 1, 40, 50}, {1, 20, 60, 90}, {2, 2, 60, 90}};
  for (int sizes = 0; sizes < 4; ++sizes) {
    const Shape &s = source_shapes[sizes], &t = target_shapes[sizes];
    for (const bool distort : {false, true}) {
      for (const Padding padding : paddings) {
        for (const Interpolation interpolation : interpolations) {
          for (const bool channels_last : {false, true}) {
            Resampling resampling = rectify();
            if (distort) std::swap(resampling.source, resampling.target);
            resampling.source_from_target = turned;
            resampling.padding = padding, resampling.interpolation = interpolation;
            const auto layout = [&](const Shape& shape) { return channels_last ? interleaved(shape) : planar(shape); };
            for (const ScalarType type : {ScalarType::float64, ScalarType::float32}) {
              const Picture x(type, s, layout(s)), y(type, t, layout(t)), grad(type, s, layout(s));
              x.fill(noise);
              y.fill([](int64_t b, int64_t c, int64_t i, int64_t j) { return noise(b + 5, c, i, j) - 100; });
              grad.fill_bytes(0xee);
              const Output out = run(resampling, x, t, layout(t));
              resample_backward(resampling, x.image, y.image, {&grad.image, nullptr, nullptr, nullptr});
              const double forward = dot(out.target, y), size = std::sqrt(dot(out.target, out.target) * dot(y, y)) + 1;
              CHECK_NEAR(dot(x, grad), forward, (type == ScalarType::float64 ? 1e-13 : 2e-5) * size);
            }
          }
        }
      }
    }
  }
}

// A linear image is reproduced exactly, so the loss is smooth and differences are sharp.
TEST(parameter_gradients_match_differences) {
  const Shape s{1, 2, 60, 80}, t{1, 2, 20, 30};
  const double narrow_view[4] = {70, 75, 14.7, 9.6};
  for (const bool distort : {false, true}) {
    for (const bool channels_last : {false, true}) {
      const Picture x(ScalarType::float64, s, channels_last ? interleaved(s) : planar(s));
      const Picture y(ScalarType::float64, t, channels_last ? interleaved(t) : planar(t));
      x.fill([](int64_t, int64_t c, int64_t i, int64_t j) {
        return c ? 0.3 * double(i) - 0.2 * double(j) : 0.1 * double(i) + 0.5 * double(j) + 2;
      });
      y.fill([](int64_t b, int64_t c, int64_t i, int64_t j) { return noise(b, c, i, j) / 100 - 1; });
      double fisheye[8], pinhole[4], rotation[9];
      std::copy(lens, lens + 8, fisheye), std::copy(narrow_view, narrow_view + 4, pinhole),
          std::copy(turned, turned + 9, rotation);
      if (distort) {
        fisheye[0] = 70, fisheye[1] = 75, fisheye[2] = 14.7, fisheye[3] = 9.6;
        pinhole[2] = 40, pinhole[3] = 30;
      }
      Resampling resampling = rectify(fisheye, pinhole);
      if (distort) std::swap(resampling.source, resampling.target);
      resampling.source_from_target = rotation;
      const auto loss = [&] {
        return dot(run(resampling, x, t, channels_last ? interleaved(t) : planar(t)).target, y);
      };
      ParameterGradients grads(resampling, 1);
      resample_backward(resampling, x.image, y.image, grads.with(nullptr));
      const auto compare = [&](double* params, const std::vector<double>& actual) {
        for (size_t i = 0; i < actual.size(); ++i) {
          const Derivative d = derivative(loss, params[i], std::max(1e-3, 1e-4 * std::abs(params[i])));
          CHECK_NEAR(actual[i], d.value, 1e-8 * (1 + std::abs(d.value)) + d.rounding);
          CHECK(actual[i] != 0);
        }
      };
      for (const uint8_t valid : run(resampling, x, t).valid) CHECK(valid == 1);
      compare(distort ? pinhole : fisheye, grads.source);
      compare(distort ? fisheye : pinhole, grads.target);
      compare(rotation, grads.rotation);
    }
  }
}

TEST(only_the_gradients_asked_for_are_written_and_they_do_not_depend_on_the_others) {
  const Shape s{2, 3, 60, 80}, t{2, 3, 50, 70};
  const Picture x(ScalarType::float32, s), y(ScalarType::float32, t), all_image(ScalarType::float32, s);
  x.fill(noise), y.fill(noise);
  Resampling resampling = rectify();
  resampling.source_from_target = turned;
  ParameterGradients all(resampling, 2);
  resample_backward(resampling, x.image, y.image, all.with(&all_image));
  for (int asked = 0; asked < 16; ++asked) {
    const Picture image(ScalarType::float32, s);
    image.fill_bytes(0xee);
    ParameterGradients some(resampling, 2);
    Gradients gradients = some.with(&image);
    if (!(asked & 1)) gradients.source = nullptr;
    if (!(asked & 2)) gradients.source_params = nullptr;
    if (!(asked & 4)) gradients.target_params = nullptr;
    if (!(asked & 8)) gradients.source_from_target = nullptr;
    resample_backward(resampling, x.image, y.image, gradients);
    if (asked & 1) CHECK(same(image, all_image));
    if (asked & 2) CHECK(some.source == all.source);
    if (asked & 4) CHECK(some.target == all.target);
    if (asked & 8) CHECK(some.rotation == all.rotation);
  }
}

TEST(results_are_the_same_bits_for_any_number_of_threads) {
  for (const bool channels_last : {false, true}) {
    for (const ScalarType type : {ScalarType::float32, ScalarType::float64, ScalarType::float16, ScalarType::uint8}) {
      const Shape s{3, 4, 60, 80}, t{3, 4, 64, 301};
      const Picture x(type, s, channels_last ? interleaved(s) : planar(s));
      const Picture y(type, t, channels_last ? interleaved(t) : planar(t));
      x.fill(noise), y.fill(noise);
      Resampling resampling = rectify();
      resampling.source_from_target = turned;
      std::vector<Output> outputs;
      std::vector<Picture> grads;
      std::vector<ParameterGradients> params;
      for (const int threads : {1, 2, 3, 7}) {
        resampling.threads = threads;
        outputs.push_back(run(resampling, x, t, channels_last ? interleaved(t) : planar(t)));
        CHECK(std::memcmp(outputs.back().target.bytes(), outputs[0].target.bytes(), outputs[0].target.byte_count()) ==
              0);
        CHECK(outputs.back().valid == outputs[0].valid);
        if (type == ScalarType::uint8) continue;
        grads.emplace_back(gradient_type(type), s, channels_last ? interleaved(s) : planar(s));
        params.emplace_back(resampling, s.batch);
        resample_backward(resampling, x.image, y.image, params.back().with(&grads.back()));
        CHECK(std::memcmp(grads.back().bytes(), grads[0].bytes(), grads[0].byte_count()) == 0);
        CHECK(params.back() == params[0]);
      }
    }
  }
}

TEST(strides_only_say_where_pixels_lie) {
  const Shape s{2, 3, 31, 45}, t{2, 3, 33, 290};
  const double small_lens[8] = {30, 31, 22.3, 15.1, 0.05, -0.02, 0.01, -0.003};
  const Resampling resampling = rectify(small_lens, view);
  const Strides sp = planar(s), si = interleaved(s), tp = planar(t), ti = interleaved(t);
  const Strides source_layouts[] = {sp,
                                    si,
                                    {-sp.batch, -sp.channel, -sp.y, -sp.x},
                                    {si.batch, -si.channel, -si.y, si.x},
                                    {3 * sp.batch, 3 * sp.channel, 3 * sp.y, 3},
                                    {2 * si.batch, 1, 2 * si.y, 2 * si.x},
                                    {si.batch, 1, -si.y, -si.x},
                                    {1, s.batch, -s.batch * s.channels * s.width, s.batch * s.channels}};
  // resample.h: pixels side by side, or channels as in the source.
  const Strides target_layouts[] = {tp,
                                    {-tp.batch, -tp.channel, -tp.y, 1},
                                    {2 * tp.batch, 2 * tp.channel, 2 * tp.y, 1},
                                    {t.width, t.batch * t.width, t.batch * t.channels * t.width, 1},
                                    ti,
                                    {2 * ti.batch, 1, 2 * ti.y, 2 * ti.x},
                                    {ti.batch, 1, -ti.y, -ti.x}};
  for (const ScalarType type : {ScalarType::uint8, ScalarType::float32, ScalarType::float64}) {
    const double tolerance = type == ScalarType::uint8 ? 1 : type == ScalarType::float32 ? 1e-3 : 1e-11;
    const Picture plain(type, s), plain_y(type, t), plain_grad(gradient_type(type), s);
    plain.fill(noise), plain_y.fill(noise);
    const Output expected = run(resampling, plain, t);
    ParameterGradients expected_params(resampling, 2);
    if (type != ScalarType::uint8)
      resample_backward(resampling, plain.image, plain_y.image, expected_params.with(&plain_grad));
    for (const Strides& source_strides : source_layouts) {
      for (const Strides& target_strides : target_layouts) {
        if (target_strides.x != 1 && source_strides.channel != 1) continue;
        const Picture source(type, s, source_strides);
        source.fill(noise);
        const Output out = run(resampling, source, t, target_strides);
        CHECK(out.valid == expected.valid);
        out.target.for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) {
          CHECK_NEAR(out.target.get(b, c, y, x), expected.target.get(b, c, y, x), tolerance);
        });
        if (type == ScalarType::uint8) continue;
        const Picture grad_target(type, t, target_strides), grad(type, s, source_strides);
        grad_target.fill(noise);
        ParameterGradients params(resampling, 2);
        resample_backward(resampling, source.image, grad_target.image, params.with(&grad));
        grad.for_each([&](int64_t b, int64_t c, int64_t y, int64_t x) {
          const double value = plain_grad.get(b, c, y, x);
          CHECK_NEAR(grad.get(b, c, y, x), value, tolerance * (1 + std::abs(value)));
        });
        for (size_t i = 0; i < params.source.size(); ++i) {
          CHECK_NEAR(params.source[i], expected_params.source[i],
                     tolerance * (1 + std::abs(expected_params.source[i])));
        }
      }
    }
  }
}

TEST(a_batch_of_one_image_may_be_repeated_without_a_copy) {
  const Shape s{3, 1, 20, 20}, t{3, 1, 20, 20};
  const double three_views[12] = {20, 20, 9.5, 9.5, 30, 30, 9.5, 9.5, 40, 40, 9.5, 9.5},
               source_lens[8] = {20, 20, 9.5, 9.5, 0, 0, 0, 0};
  Resampling resampling = rectify(source_lens, three_views);
  resampling.target.stride = 4;
  const Picture once(ScalarType::float32, s, {0, 400, 20, 1});
  once.fill([](int64_t, int64_t c, int64_t y, int64_t x) { return noise(0, c, y, x); });
  const Output out = run(resampling, once, t);
  for (int b = 0; b < 3; ++b) {
    const Picture alone(ScalarType::float32, {1, 1, 20, 20});
    alone.fill(noise);
    const Output expected = run(rectify(source_lens, three_views + 4 * b), alone, {1, 1, 20, 20});
    expected.target.for_each([&](int64_t, int64_t c, int64_t y, int64_t x) {
      CHECK(out.target.get(b, c, y, x) == expected.target.get(0, c, y, x));
    });
  }
}

// One row that stands for all rows (stride_y = 0): its gradient is as high as the image it stands for.
TEST(an_image_of_one_repeated_row_gets_its_whole_gradient_on_any_number_of_threads) {
  const Shape s{1, 2, 60, 80}, t{1, 2, 64, 300};
  const Picture repeated(ScalarType::float32, s, {0, 80, 0, 1}), y(ScalarType::float32, t);
  y.fill(noise);
  Resampling resampling = rectify();
  resampling.padding = Padding::border;
  const Picture expected(ScalarType::float32, s);
  resample_backward(resampling, Picture(ScalarType::float32, s).image, y.image,
                    {&expected.image, nullptr, nullptr, nullptr});
  for (const int threads : {1, 2, 7}) {
    resampling.threads = threads;
    const Picture grad(ScalarType::float32, s);
    resample_backward(resampling, repeated.image, y.image, {&grad.image, nullptr, nullptr, nullptr});
    CHECK(same(grad, expected));
  }
}

TEST(every_image_of_a_batch_has_its_own_cameras_rotation_and_gradients) {
  const Shape one{1, 2, 60, 80}, two{2, 2, 60, 80};
  double lenses[16], rotations[18] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  std::copy(lens, lens + 8, lenses), std::copy(lens, lens + 8, lenses + 8),
      std::copy(turned, turned + 9, rotations + 9);
  lenses[8] = 80, lenses[12] = -0.1;
  Resampling both = rectify(lenses);
  both.source.stride = 8, both.source_from_target = rotations, both.rotation_stride = 9;
  const Picture x(ScalarType::float64, two), y(ScalarType::float64, two);
  x.fill(noise), y.fill(noise);
  const Output out = run(both, x, two);
  ParameterGradients grads(both, 2);
  resample_backward(both, x.image, y.image, grads.with(nullptr));
  for (int b = 0; b < 2; ++b) {
    Resampling single = rectify(lenses + 8 * b);
    single.source_from_target = rotations + 9 * b;
    const Picture xb(ScalarType::float64, one), yb(ScalarType::float64, one);
    xb.fill([&](int64_t, int64_t c, int64_t i, int64_t j) { return noise(b, c, i, j); });
    yb.fill([&](int64_t, int64_t c, int64_t i, int64_t j) { return noise(b, c, i, j); });
    const Output alone = run(single, xb, one);
    ParameterGradients alone_grads(single, 1);
    resample_backward(single, xb.image, yb.image, alone_grads.with(nullptr));
    alone.target.for_each([&](int64_t, int64_t c, int64_t i, int64_t j) {
      CHECK(alone.target.get(0, c, i, j) == out.target.get(b, c, i, j));
    });
    for (size_t i = 0; i < 8; ++i) CHECK(alone_grads.source[i] == grads.source[static_cast<size_t>(8 * b) + i]);
    for (size_t i = 0; i < 4; ++i) CHECK(alone_grads.target[i] == grads.target[static_cast<size_t>(4 * b) + i]);
    for (size_t i = 0; i < 9; ++i) CHECK(alone_grads.rotation[i] == grads.rotation[static_cast<size_t>(9 * b) + i]);
  }
}

TEST(nan_and_infinite_parameters_give_zeros_and_nothing_valid) {
  const Shape s{1, 2, 20, 30}, t{1, 2, 10, 300};
  for (const ScalarType type : {ScalarType::float32, ScalarType::float64, ScalarType::uint8}) {
    const Picture x(type, s), y(type, t);
    x.fill(noise), y.fill(noise);
    for (const double bad : {not_a_number, infinity, -infinity}) {
      for (int which = 0; which < 8 + 4 + 9; ++which) {
        double fisheye[8], pinhole[4], rotation[9];
        std::copy(lens, lens + 8, fisheye), std::copy(view, view + 4, pinhole), std::copy(turned, turned + 9, rotation);
        (which < 8 ? fisheye[which] : which < 12 ? pinhole[which - 8] : rotation[which - 12]) = bad;
        for (const bool distort : {false, true}) {
          for (const Padding padding : paddings) {
            for (const Interpolation interpolation : interpolations) {
              Resampling resampling = rectify(fisheye, pinhole);
              if (distort) std::swap(resampling.source, resampling.target);
              resampling.source_from_target = rotation;
              resampling.padding = padding, resampling.interpolation = interpolation;
              const Output out = run(resampling, x, t);
              for (const uint8_t valid : out.valid) CHECK(valid == 0);
              out.target.for_each(
                  [&](int64_t b, int64_t c, int64_t i, int64_t j) { CHECK(out.target.get(b, c, i, j) == 0); });
              if (type == ScalarType::uint8) continue;
              const Picture grad(type, s);
              grad.fill_bytes(0xee);
              ParameterGradients grads(resampling, 1);
              resample_backward(resampling, x.image, y.image, grads.with(&grad));
              grad.for_each([&](int64_t b, int64_t c, int64_t i, int64_t j) { CHECK(grad.get(b, c, i, j) == 0); });
              for (const auto* values : {&grads.source, &grads.target, &grads.rotation}) {
                for (const double value : *values) CHECK(value == 0);
              }
            }
          }
        }
      }
    }
  }
}

// Finite in double, infinite in float, or infinite once squared.
TEST(enormous_and_tiny_parameters_are_harmless) {
  const double extremes[] = {0, 1e-30, 1e10, 1e50, -1e50, 1e200, 1e307};
  const Shape s{1, 1, 8, 9}, t{1, 1, 7, 20};
  for (const ScalarType type : {ScalarType::float32, ScalarType::float64}) {
    const Picture x(type, s), y(type, t), grad(type, s);
    x.fill(noise), y.fill(noise);
    for (const double first : extremes) {
      for (const double second : extremes) {
        for (int i = 0; i < 8; ++i) {
          for (int j = i; j < 8; ++j) {
            double fisheye[8];
            std::copy(lens, lens + 8, fisheye);
            fisheye[i] = first, fisheye[j] = second;
            for (const bool distort : {false, true}) {
              Resampling resampling = rectify(fisheye);
              if (distort) std::swap(resampling.source, resampling.target);
              const Output out = run(resampling, x, t);
              for (const uint8_t valid : out.valid) CHECK(valid <= 1);
              out.target.for_each([&](int64_t b, int64_t c, int64_t row, int64_t column) {
                CHECK(out.target.get(b, c, row, column) >= 0 && out.target.get(b, c, row, column) <= 200.001);
              });
              ParameterGradients grads(resampling, 1);
              resample_backward(resampling, x.image, y.image, grads.with(&grad));
              grad.for_each([&](int64_t b, int64_t c, int64_t row, int64_t column) {
                CHECK(std::isfinite(grad.get(b, c, row, column)));
              });
            }
          }
        }
      }
    }
  }
}

TEST(one_image_with_nan_parameters_does_not_spoil_its_batch) {
  const Shape s{2, 1, 60, 80};
  double lenses[16];
  std::copy(lens, lens + 8, lenses), std::copy(lens, lens + 8, lenses + 8);
  lenses[4] = not_a_number;
  Resampling resampling = rectify(lenses);
  resampling.source.stride = 8;
  const Picture x(ScalarType::float32, s);
  x.fill(noise);
  const Output out = run(resampling, x, s);
  CHECK(std::count(out.valid.begin(), out.valid.begin() + 4800, 1) == 0);
  CHECK(std::count(out.valid.begin() + 4800, out.valid.end(), 1) > 2400);
}

TEST(halves_and_bytes_are_the_floats_rounded) {
  const Shape s{1, 3, 60, 80}, t{1, 3, 40, 300};
  const Resampling resampling = rectify();
  const Picture reference(ScalarType::float32, s);
  reference.fill(noise);  // whole numbers up to 200: exact in every type
  const Output expected = run(resampling, reference, t);
  for (const ScalarType type : {ScalarType::uint8, ScalarType::float16, ScalarType::bfloat16}) {
    const Picture x(type, s);
    x.fill(noise);
    const Output out = run(resampling, x, t);
    CHECK(out.valid == expected.valid);
    out.target.for_each([&](int64_t b, int64_t c, int64_t i, int64_t j) {
      const double value = expected.target.get(b, c, i, j);
      const bool bytes = type == ScalarType::uint8;
      const double spacing = bytes ? 1 : value * (type == ScalarType::float16 ? 0x1p-10 : 0x1p-7);
      const double weights = bytes ? 255 * 1.5 / (1 << 15) : 0;  // rounded to whole numbers, sample_bytes.h
      CHECK_NEAR(out.target.get(b, c, i, j), value, spacing / 2 + weights + 1e-4);
    });
  }
}

TEST(empty_batches_channels_and_targets_are_fine) {
  for (const Shape& t : {Shape{0, 3, 20, 20}, {1, 0, 20, 20}, {1, 3, 0, 20}, {1, 3, 20, 0}}) {
    const Shape s{t.batch, t.channels, 20, 20};
    const Picture x(ScalarType::float32, s), y(ScalarType::float32, t), grad(ScalarType::float32, s);
    const Output out = run(rectify(), x, t);
    grad.fill_bytes(0xee);
    ParameterGradients grads(rectify(), t.batch);
    resample_backward(rectify(), x.image, y.image, grads.with(&grad));
    grad.for_each([&](int64_t b, int64_t c, int64_t i, int64_t j) { CHECK(grad.get(b, c, i, j) == 0); });
    for (const double value : grads.source) CHECK(value == 0);
  }
}

TEST(points_go_out_and_come_back) {
  const Cameras camera{CameraModel::kannala_brandt, lens, 0};
  const double pixels[6] = {40.3, 29.8, 10, 20, 1e6, 1e6};
  double rays[9], back[6];
  uint8_t valid[3];
  unproject(camera, pixels, 3, rays, valid);
  CHECK(valid[0] == 1 && valid[1] == 1 && valid[2] == 0);
  CHECK(std::isnan(rays[6]) && std::isnan(rays[7]) && std::isnan(rays[8]));
  project(camera, rays, 3, back, valid);
  CHECK(valid[0] == 1 && valid[1] == 1 && valid[2] == 0);
  for (int i = 0; i < 4; ++i) CHECK_NEAR(back[i], pixels[i], 1e-12);
  const double broken[8] = {not_a_number, 1, 1, 1, 0, 0, 0, 0};
  unproject({CameraModel::kannala_brandt, broken, 0}, pixels, 3, rays, valid);
  CHECK(valid[0] == 0 && std::isnan(rays[0]));
}

#if defined(__linux__)
// More than 2^31 elements, of which only the few that are written ever take memory.
TEST(offsets_beyond_two_to_the_31_elements_reach_the_right_pixels) {
  constexpr int64_t side = 46400;  // side^2 > 2^31
  const int64_t bytes = (side * side + 4096) * 4;
  void* memory = mmap(nullptr, static_cast<size_t>(bytes), PROT_READ | PROT_WRITE,
                      MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  if (memory == MAP_FAILED) {
    std::printf("skipped %s: mmap of %lld bytes failed\n", __func__, static_cast<long long>(bytes));
    return;
  }
  struct Layout {
    const char* name;
    Shape shape;
    Strides strides;
  };
  const Layout layouts[] = {{"one plane", {1, 1, side, side}, {0, 0, side, 1}},
                            {"two planes", {1, 2, 4, 8}, {0, side * side - 32, 8, 1}},
                            {"two images", {2, 1, 4, 8}, {side * side - 32, 32, 8, 1}},
                            {"interleaved", {1, 2, side, side / 2}, {0, 1, side, 2}},
                            {"long rows", {1, 1, 3, 8}, {0, 0, side * side / 2 - 32, 1}}};
  for (const Layout& layout : layouts) {
    check::subject = layout.name;
    const Shape& s = layout.shape;
    const int64_t last_b = s.batch - 1, last_c = s.channels - 1;
    for (const ScalarType type : {ScalarType::float32, ScalarType::uint8}) {
      const Image source{memory,
                         type,
                         s.batch,
                         s.channels,
                         s.height,
                         s.width,
                         layout.strides.batch,
                         layout.strides.channel,
                         layout.strides.y,
                         layout.strides.x};
      // The last 2x2 pixels of the last channel of the last image.
      const double value[2][2] = {{10, 20}, {40, 80}};
      for (int64_t y = 0; y < 2; ++y) {
        for (int64_t x = 0; x < 2; ++x) {
          const int64_t at = last_b * layout.strides.batch + last_c * layout.strides.channel +
                             (s.height - 2 + y) * layout.strides.y + (s.width - 2 + x) * layout.strides.x;
          if (type == ScalarType::float32)
            static_cast<float*>(memory)[at] = static_cast<float>(value[y][x]);
          else
            static_cast<uint8_t*>(memory)[at] = static_cast<uint8_t>(value[y][x]);
        }
      }
      const double left = static_cast<double>(s.width - 2), top = static_cast<double>(s.height - 2);
      for (const Interpolation interpolation : interpolations) {
        const Shape t{s.batch, s.channels, 2, 2};
        const Picture target(type, t);
        std::vector<uint8_t> valid(static_cast<size_t>(s.batch * 4));
        resample(Shift(left, top, interpolation).resampling, source, target.image, valid.data());
        for (int64_t y = 0; y < 2; ++y) {
          for (int64_t x = 0; x < 2; ++x) CHECK(target.get(last_b, last_c, y, x) == value[y][x]);
        }
      }
      if (type != ScalarType::float32) continue;
      const Picture y(type, {s.batch, s.channels, 1, 1});
      y.set(last_b, last_c, 0, 0, 1);
      const Shift shift(left + 0.5, top + 0.5, Interpolation::bilinear);
      ParameterGradients grads(shift.resampling, s.batch);
      resample_backward(shift.resampling, source, y.image, grads.with(nullptr));
      CHECK_NEAR(grads.source[static_cast<size_t>(4 * last_b + 2)], (20 - 10 + 80 - 40) / 2.0, 1e-3);
      CHECK_NEAR(grads.source[static_cast<size_t>(4 * last_b + 3)], (40 - 10 + 80 - 20) / 2.0, 1e-3);
    }
  }
  munmap(memory, static_cast<size_t>(bytes));
}
#endif
