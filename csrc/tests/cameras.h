// The cameras that every geometric test walks.
#pragma once

namespace fisheyerec {

struct NamedCamera {
  const char* name;
  int width, height;
  double params[8];
  bool folds_in_frame;  // the corners lie beyond the largest theta_d
};

// Calibrations from gyroflow/lens_profiles (CC0), chosen for what is awkward about them, and ideal projections.
inline constexpr NamedCamera cameras[] = {
    {"AKASO B8",
     3840,
     2880,
     {1845.07575, 1843.095555, 1920.14339, 1418.685398, -0.134839, 0.391574, -0.3363, 0.101123},
     false},
    {"GoPro Max Lens 2.0: 180 degrees, the limit just outside the frame",
     4000,
     3000,
     {1399.680374, 1400.498497, 2004.723614, 1484.827881, 0.140723, -0.102274, 0.060766, -0.0135},
     false},
    {"Sigma 8mm circular: theta_d(pi) = 255",
     6144,
     3456,
     {2191.275694, 2198.292554, 3179.221704, 1679.645838, -0.027677, 0.036589, -0.042993, 0.012442},
     false},
    {"Caddx Walnut: folds at 98 degrees",
     1920,
     1080,
     {765.57728, 765.524, 947.002645, 537.443739, 0.044169, -0.037324, 0.009211, -0.002135},
     false},
    {"TTArtisan 7.5mm: folds within its frame",
     3840,
     2160,
     {1048.449194, 1039.940528, 1919.289781, 1095.458192, -0.007755, -0.006264, 0.001833, -0.001005},
     true},
    {"GoPro Max: folds within its frame",
     1920,
     1440,
     {617.423308, 617.356748, 971.283364, 718.977379, 0.175771, -0.128997, 0.096336, -0.023876},
     true},
    {"Xiaomi Yi 4k: folds at 55 degrees",
     1920,
     1080,
     {912.215518, 909.60451, 949.250851, 713.713436, 0.578729, -1.018157, 2.985929, -2.258767},
     true},
    {"Sony a7 with 85 mm: k4 = -8.5e10",
     1920,
     1080,
     {31633.414066, 31961.740792, 938.167139, 540.341455, 28.582488, -23693.218934, 88427014.309422,
      -85136991618.37608},
     true},
    {"AKASO Brave 6 Plus: fx is not fy",
     1920,
     1080,
     {873.74865, 959.76701, 999.573202, 538.273751, 0.221975, 0.084721, -0.150791, 0.17056},
     false},
    {"equidistant, 250 degrees", 1000, 1000, {324, 324, 499.5, 499.5, 0, 0, 0, 0}, false},
    {"stereographic, 220 degrees",
     640,
     480,
     {140, 140, 319.5, 239.5, 0.08333333333, 0.00833333333, 0.00084325397, 8.54277e-05},
     false},
    {"equisolid, 200 degrees",
     640,
     480,
     {260, 260, 319.5, 239.5, -0.04166666667, 0.00052083333, -3.1002e-06, 1.0764e-08},
     false},
    {"mirrored: fx < 0", 640, 480, {-300, 300, 319.5, 239.5, 0.02, -0.003, 0.001, -0.0002}, false},
};

}  // namespace fisheyerec
