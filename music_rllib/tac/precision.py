"""Whether this machine multiplies in bfloat16, which `tac.precision: bf16` needs."""

from __future__ import annotations

import functools
from pathlib import Path

import torch

__all__ = ["PrecisionError", "check_precision", "cpu_flags", "has_bf16"]

_CPU_FLAGS = frozenset({"amx_bf16", "avx512_bf16", "bf16"})
"""As Linux names them: Intel and AMD, and `bf16` on ARM."""


class PrecisionError(ValueError):
    """A precision that the hardware lacks: it would be emulated, far slower than float32."""


def check_precision(precision: str, device: str | torch.device = "cpu") -> None:
    """Refuses bfloat16 where it is not in the hardware.

    Args:
        precision: `TACSettings.precision`.
        device: where the Learner runs.

    Raises:
        PrecisionError: `bf16` without instructions for it.
    """
    if precision == "float32" or has_bf16(device):
        return
    flags = ", ".join(sorted(_CPU_FLAGS))
    lacks = f"this CPU has none of {flags}"
    if torch.device(device).type == "cuda":
        lacks = f"{torch.cuda.get_device_name()} has no bfloat16 units"
    raise PrecisionError(
        f"tac.precision must be float32 here, got 'bf16': {lacks}, so that it would be emulated"
    )


def has_bf16(device: str | torch.device = "cpu") -> bool:
    """Whether the device has instructions for bfloat16 products."""
    if torch.device(device).type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(cpu_flags() & _CPU_FLAGS)


@functools.cache
def cpu_flags() -> frozenset[str]:
    """Instruction sets as /proc/cpuinfo has them; none where there is no such file."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    described = (line.partition(":") for line in lines)
    found = next((v for key, _, v in described if key.strip() in {"flags", "Features"}), "")
    return frozenset(found.split())
