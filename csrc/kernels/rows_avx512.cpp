// The same loops for x86-64 with AVX-512 (F, BW, DQ, VL).
#if defined(__x86_64__) && defined(__GNUC__)

// The standard library is included before the target changes: its inline functions are shared by the whole program.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <utility>

#ifdef __clang__
#pragma clang attribute push(__attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,f16c,bmi,bmi2"))), \
                             apply_to = function)
#else
#pragma GCC target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma,f16c,bmi,bmi2,prefer-vector-width=512")
#endif

#define FISHEYEREC_ISA avx512_isa
#define FISHEYEREC_VECTOR_BYTES 64
#include "rows.h"

namespace fisheyerec {
extern const InstructionSet avx512{row_kernels<float>(), row_kernels<double>()};
}

#ifdef __clang__
#pragma clang attribute pop
#endif
#endif
