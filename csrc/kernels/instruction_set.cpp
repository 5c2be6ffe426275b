#define FISHEYEREC_ISA dispatch_isa
#include <cstdlib>
#include <string>

#include "rows_table.h"

namespace fisheyerec {
namespace {

const InstructionSet& choose() {
#if defined(__x86_64__) && defined(__GNUC__)
  const char* wanted = std::getenv("FISHEYEREC_ISA");
  const std::string highest = wanted ? wanted : "avx512";
  __builtin_cpu_init();
  const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                        __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
  const bool has_avx512 = has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                          __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  if (has_avx512 && highest == "avx512") return avx512;
  if (has_avx2 && highest != "baseline") return avx2;
#endif
  return baseline;
}

}  // namespace

const InstructionSet& instruction_set() {
  static const InstructionSet& chosen = choose();
  return chosen;
}

}  // namespace fisheyerec
