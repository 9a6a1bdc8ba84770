"""Version of the computation of a training run."""

ALGORITHM_VERSION = "4"
"""Increased when the computation changes; runs of older versions are not reused.

Changes of rounding do not increase it: rounding also differs between CPUs and releases of PyTorch,
and runs of different machines are compared with each other.
"""
