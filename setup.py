"""Builds the two compiled modules: the torch op (stable ABI) and the NumPy door, over the same kernels."""

from pathlib import Path

import pybind11
from setuptools import Extension, setup
from torch.utils.cpp_extension import BuildExtension, CppExtension

KERNELS = sorted(str(path) for path in Path("csrc/kernels").glob("*.cpp"))

# No -ffast-math: NaN must stay NaN. These two only give up errno and floating point traps, which nobody reads, and
# let the compiler turn branches into selects.
FLAGS = ["-O3", "-fno-math-errno", "-fno-trapping-math", "-fopenmp", "-fvisibility=hidden", "-Wno-psabi"]
LINK_FLAGS = ["-fopenmp"]

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
