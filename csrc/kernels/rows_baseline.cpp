#define FISHEYEREC_ISA baseline_isa
#include "rows.h"

namespace fisheyerec {
extern const InstructionSet baseline{row_kernels<float>(), row_kernels<double>()};
}
