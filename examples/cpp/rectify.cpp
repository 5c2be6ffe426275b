// rectify IN.ppm OUT.ppm FX FY CX CY K1 K2 K3 K4 [FOV_DEG]: makes a fisheye picture straight (binary PPM, 8 bits).
#include <fisheyerec/kernels/resample.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace {

struct Picture {
  int64_t width, height;
  std::vector<uint8_t> rgb;

  fisheyerec::Image image() {  // one image of three interleaved channels
    return {rgb.data(), fisheyerec::ScalarType::uint8, 1, 3, height, width, 0, 1, 3 * width, 3};
  }
};

Picture read_ppm(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::string magic;
  int64_t width = 0, height = 0, levels = 0;
  if (!(file >> magic >> width >> height >> levels) || magic != "P6" || levels != 255) {
    throw std::runtime_error(path + ": expected a binary PPM (P6) without comments and 255 levels");
  }
  if (width < 1 || height < 1 || width > 1 << 16 || height > 1 << 16) {
    throw std::runtime_error(path + ": expected sides of 1 to 65536 pixels");
  }
  file.get();
  Picture picture{width, height, std::vector<uint8_t>(static_cast<size_t>(3 * width * height))};
  file.read(reinterpret_cast<char*>(picture.rgb.data()), static_cast<std::streamsize>(picture.rgb.size()));
  if (!file) throw std::runtime_error(path + ": the file ends before its last pixel");
  return picture;
}

void write_ppm(const std::string& path, const Picture& picture) {
  const std::string unfinished = path + ".part";
  std::ofstream file(unfinished, std::ios::binary);
  file << "P6\n" << picture.width << " " << picture.height << "\n255\n";
  file.write(reinterpret_cast<const char*>(picture.rgb.data()), static_cast<std::streamsize>(picture.rgb.size()));
  file.close();
  if (!file || std::rename(unfinished.c_str(), path.c_str()) != 0) {
    std::remove(unfinished.c_str());
    throw std::runtime_error(path + ": cannot be written");
  }
}

double number(const char* text) {
  char* end = nullptr;
  const double value = std::strtod(text, &end);
  if (end == text || *end || !std::isfinite(value)) throw std::runtime_error(std::string(text) + ": expected a number");
  return value;
}

void rectify(int argc, char** argv) {
  if (argc != 11 && argc != 12) {
    throw std::runtime_error("usage: rectify IN.ppm OUT.ppm FX FY CX CY K1 K2 K3 K4 [FOV_DEG]");
  }
  double lens[8];
  for (int i = 0; i < 8; ++i) lens[i] = number(argv[3 + i]);
  const double fov_deg = argc == 12 ? number(argv[11]) : 90;
  if (!(fov_deg > 0 && fov_deg < 180)) throw std::runtime_error("expected a field of view between 0 and 180 degrees");

  Picture fisheye = read_ppm(argv[1]);
  Picture straight{fisheye.width, fisheye.height, std::vector<uint8_t>(fisheye.rgb.size())};
  const double width = static_cast<double>(straight.width), height = static_cast<double>(straight.height);
  const double focal = width / 2 / std::tan(fov_deg / 2 * std::acos(-1.0) / 180);
  const double view[4] = {focal, focal, (width - 1) / 2, (height - 1) / 2};

  std::vector<uint8_t> valid(static_cast<size_t>(straight.width * straight.height));
  const fisheyerec::Resampling resampling{{fisheyerec::CameraModel::kannala_brandt, lens, 0},
                                          {fisheyerec::CameraModel::pinhole, view, 0},
                                          nullptr,
                                          0,
                                          fisheyerec::Interpolation::bilinear,
                                          fisheyerec::Padding::zeros,
                                          static_cast<int>(std::thread::hardware_concurrency())};
  fisheyerec::resample(resampling, fisheye.image(), straight.image(), valid.data());
  write_ppm(argv[2], straight);
}

}  // namespace

int main(int argc, char** argv) {
  try {
    rectify(argc, argv);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "rectify: %s\n", error.what());
    return 2;
  }
  return 0;
}
