"""Matrix products for compiled code, by the library that is faster on this CPU.

MKL, which is part of PyTorch, uses AVX-512 on Intel's CPUs only; SciPy's OpenBLAS uses it on
others too (docs/performance.md has a table). The choice depends on the machine's description, not
on a measurement: a seed must always give the same numbers.

OpenBLAS copies both matrices before it multiplies them, except in small products on a CPU with
AVX-512. Larger products are therefore cut into small ones, which saves a seventh to a quarter of
the time. OpenBLAS has no such path if the right matrix is transposed.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (its functions' addresses are looked up by name)
import torch
from numba import types
from numba.extending import get_cython_function_address, overload
from threadpoolctl import threadpool_info, threadpool_limits

_PREFIX = "music_rllib_"
_ROUTINES = {types.float32: "sgemm", types.float64: "dgemm"}
_NO, _YES = ord("N"), ord("T")
_WITHOUT_COPIES = ("SkylakeX", "Cooperlake", "SapphireRapids")
"""OpenBLAS's names of CPUs on which it multiplies small matrices without copies."""
_SMALL = 100**3
"""Largest number of multiplications of such a product."""
_TILE = 12
"""Rows that its kernel computes together; products of a multiple of them are fastest."""


def library() -> str:
    """Name of the library used on this machine: `MKL` or `OpenBLAS`."""
    return "MKL" if _cpu_vendor() == "GenuineIntel" and _in_mkl("sgemm") else "OpenBLAS"


def cuts_products() -> bool:
    """Whether products are cut into small ones."""
    kernels = (info["architecture"] for info in threadpool_info() if "scipy" in info["filepath"])
    return library() == "OpenBLAS" and next(kernels, "") in _WITHOUT_COPIES


def use_threads(count: int) -> None:
    """Set the number of OpenBLAS's threads; MKL uses PyTorch's."""
    threadpool_limits(count, user_api="blas")


@functools.cache
def _cpu_vendor() -> str:
    """`GenuineIntel` or `AuthenticAMD`, from /proc/cpuinfo; empty without that file."""
    try:
        description = Path("/proc/cpuinfo").read_text()
    except OSError:
        return ""
    lines = (line.partition(":") for line in description.splitlines())
    return next((value.strip() for key, _, value in lines if key.strip() == "vendor_id"), "")


def _in_mkl(routine: str) -> int | None:
    """The address of a routine in PyTorch's library; None if it has no MKL."""
    path = Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"
    try:
        return ctypes.cast(getattr(ctypes.CDLL(str(path)), f"{routine}_"), ctypes.c_void_p).value
    except (OSError, AttributeError):
        return None


def _address(routine: str) -> int:
    found = _in_mkl(routine) if library() == "MKL" else None
    return found or get_cython_function_address("scipy.linalg.cython_blas", routine)


# Compiled code on disk refers to these names; addresses differ between processes.
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
    """Write left @ right, each optionally transposed, to out. All matrices are contiguous.

    Compiled code calls BLAS instead of this function.
    """
    np.matmul(left.T if left_transposed else left, right.T if right_transposed else right, out)


@overload(multiply)
def _multiply(left: Any, left_transposed: Any, right: Any, right_transposed: Any, out: Any) -> Any:
    gemm = _external(left.dtype)
    cut = _ROUTINES[left.dtype] == "sgemm" and cuts_products()

    # BLAS stores columns contiguously, so it sees the transposed matrices: out' = right' @ left'.
    def multiply_by_blas(
        left: Any, left_transposed: Any, right: Any, right_transposed: Any, out: Any
    ) -> None:
        rows, columns = out.shape
        depth = left.shape[0] if left_transposed else left.shape[1]
        small = _SMALL // max(columns * depth, 1) // _TILE * _TILE
        step = small if cut and small > 0 and not right_transposed else max(rows, 1)
        flags = np.empty(2, np.uint8)
        flags[0] = _YES if right_transposed else _NO
        flags[1] = _YES if left_transposed else _NO
        sizes = np.empty(6, np.int32)
        sizes[0], sizes[2] = columns, depth
        sizes[3], sizes[4], sizes[5] = right.shape[1], left.shape[1], columns
        factors = np.empty(2, left.dtype)
        factors[0], factors[1] = 1, 0
        numbers = left.reshape(left.size)
        for begin in range(0, rows, step):
            part = out[begin : begin + step]
            first = numbers[begin if left_transposed else begin * depth :]
            sizes[1] = len(part)
            gemm(
                flags.ctypes, flags[1:].ctypes, sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes,
                factors.ctypes, right.ctypes, sizes[3:].ctypes, first.ctypes, sizes[4:].ctypes,
                factors[1:].ctypes, part.ctypes, sizes[5:].ctypes,
            )  # fmt: skip

    return multiply_by_blas
