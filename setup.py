"""Builds the two compiled modules: the torch op (stable ABI) and the NumPy door, over the same kernels.

DEBUG=1 in the environment compiles without optimisation, and with symbols for a debugger.
"""

import os
import sys
from pathlib import Path

import pybind11
import torch
from setuptools import Extension, setup
from torch.utils.cpp_extension import BuildExtension, CppExtension

KERNELS = sorted(str(path) for path in Path("csrc/kernels").glob("*.cpp"))

# Python's own flags often hold -g, which would make the modules ten times as large.
FLAGS = ["-O0", "-g"] if os.environ.get("DEBUG") == "1" else ["-O3", "-g0"]
# No -ffast-math: NaN must stay NaN. These two only give up errno and floating point traps, which nobody reads, and
# let the compiler turn branches into selects.
FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden", "-Wno-psabi"]
# Messages of failed checks hold file names: not those of the machine that built the wheel.
FLAGS += [f"-ffile-prefix-map={folder}/=" for folder in (Path.cwd(), Path(torch.__file__).parents[1])]

if sys.platform == "darwin":  # Apple's compiler comes without OpenMP; parallel.h then takes std::thread
    LINK_FLAGS = []
else:
    FLAGS += ["-fopenmp"]
    # The libgomp that lies in torch's wheel: both modules and torch share one team of threads whichever is loaded
    # first, and a machine need not have a libgomp of its own. docs/decisions/0014 tells more.
    LINK_FLAGS = ["-fopenmp", "-Wl,-rpath,$ORIGIN/../torch/lib"]

setup(
    ext_modules=[
        CppExtension(
            "fisheyerec._C",
            ["csrc/torch/module.cpp", "csrc/torch/resample.cpp", *KERNELS],
            define_macros=[("TORCH_TARGET_VERSION", "0x020a000000000000")],
            extra_compile_args={"cxx": FLAGS},
            extra_link_args=LINK_FLAGS,
            py_limited_api=True,
        ),
        Extension(
            "fisheyerec._numpy",
            ["csrc/numpy/module.cpp", *KERNELS],
            include_dirs=[pybind11.get_include()],
            extra_compile_args=[*FLAGS, "-std=c++17"],
            extra_link_args=LINK_FLAGS,
            language="c++",
        ),
    ],
    cmdclass={"build_ext": BuildExtension},
)
