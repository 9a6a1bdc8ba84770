"""Whether this machine multiplies in bfloat16, which `tac.precision: bf16` needs."""

from __future__ import annotations

import functools
from pathlib import Path

import torch

__all__ = [
    "PrecisionError",
    "check_precision",
    "cpu_flags",
    "cpu_vendor",
    "has_bf16",
]

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


def cpu_flags() -> frozenset[str]:
    """Instruction sets as /proc/cpuinfo has them; none where there is no such file."""
    described = _cpu_description()
    return frozenset((described.get("flags") or described.get("Features") or "").split())


def cpu_vendor() -> str:
    """As /proc/cpuinfo has it, `GenuineIntel` or `AuthenticAMD`; empty where it does not."""
    return _cpu_description().get("vendor_id", "")


@functools.cache
def _cpu_description() -> dict[str, str]:
    """Of the first CPU."""
    try:
        first, _, _ = Path("/proc/cpuinfo").read_text().partition("\n\n")
    except OSError:
        return {}
    lines = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in lines}
