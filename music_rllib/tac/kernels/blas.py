"""Matrix products for compiled code, by the library that is faster on this CPU.

MKL, which is part of PyTorch, uses AVX-512 on Intel's CPUs only; SciPy's OpenBLAS uses it on
others too (docs/performance.md has a table). The choice follows from the machine's description and
not from a measurement: a seed has to give the same numbers.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (its functions' addresses are looked up by name)
import torch
from numba import types
from numba.extending import get_cython_function_address, overload
from threadpoolctl import threadpool_limits

from music_rllib.tac.kernels.precision import cpu_vendor

__all__ = ["library", "multiply", "use_threads"]

_PREFIX = "music_rllib_"
_ROUTINES = {types.float32: "sgemm", types.float64: "dgemm"}
_NO, _YES = ord("N"), ord("T")


def library() -> str:
    """`MKL` or `OpenBLAS`, whichever multiplies on this machine."""
    return "MKL" if cpu_vendor() == "GenuineIntel" and _in_mkl("sgemm") else "OpenBLAS"


def use_threads(count: int) -> None:
    """Lets OpenBLAS have so many threads; MKL has those of PyTorch."""
    threadpool_limits(count, user_api="blas")


def _in_mkl(routine: str) -> int | None:
    """The address of a routine in PyTorch's own library, where it has MKL."""
    path = Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"
    try:
        return ctypes.cast(getattr(ctypes.CDLL(str(path)), f"{routine}_"), ctypes.c_void_p).value
    except (OSError, AttributeError):
        return None


def _address(routine: str) -> int:
    found = _in_mkl(routine) if library() == "MKL" else None
    return found or get_cython_function_address("scipy.linalg.cython_blas", routine)


# Compiled code is kept on disk, where it has these names and not the addresses.
for _routine in _ROUTINES.values():
    llvmlite.binding.add_symbol(_PREFIX + _routine, _address(_routine))


def _external(dtype: Any) -> Any:
    """BLAS's gemm(transa, transb, m, n, k, alpha, a, lda, b, ldb, beta, c, ldc)."""
    pointer: Any = types.CPointer
    flag, size, number = pointer(types.uint8), pointer(types.int32), pointer(dtype)
    arguments = (flag, flag, size, size, size, number, number, size, number, size, number)
    signature = types.void(*arguments, number, size)
    return types.ExternalFunction(_PREFIX + _ROUTINES[dtype], signature)


def multiply(
    left: Any, left_transposed: bool, right: Any, right_transposed: bool, out: Any
) -> None:
    """Writes left @ right, either transposed, to out; their rows lie behind each other.

    Compiled code calls BLAS in place of this.
    """
    np.matmul(left.T if left_transposed else left, right.T if right_transposed else right, out)


@overload(multiply)
def _multiply(left: Any, left_transposed: Any, right: Any, right_transposed: Any, out: Any) -> Any:
    gemm = _external(left.dtype)

    # To BLAS, which has columns behind each other, these are the transposed matrices:
    # out' = right' @ left'.
    def multiply_by_blas(
        left: Any, left_transposed: Any, right: Any, right_transposed: Any, out: Any
    ) -> None:
        flags = np.empty(2, np.uint8)
        flags[0] = _YES if right_transposed else _NO
        flags[1] = _YES if left_transposed else _NO
        sizes = np.empty(6, np.int32)
        sizes[0], sizes[1] = out.shape[1], out.shape[0]
        sizes[2] = left.shape[0] if left_transposed else left.shape[1]
        sizes[3], sizes[4], sizes[5] = right.shape[1], left.shape[1], out.shape[1]
        factors = np.empty(2, left.dtype)
        factors[0], factors[1] = 1, 0
        gemm(
            flags.ctypes, flags[1:].ctypes, sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes,
            factors.ctypes, right.ctypes, sizes[3:].ctypes, left.ctypes, sizes[4:].ctypes,
            factors[1:].ctypes, out.ctypes, sizes[5:].ctypes,
        )  # fmt: skip

    return multiply_by_blas
