"""Version of everything that determines what a training run computes."""

ALGORITHM_VERSION = "4"
"""Raised with every change of what is computed: runs of older versions are not reused.

A change of rounding does not count: rounding differs between CPUs and releases of PyTorch anyway,
and runs of different machines are compared with each other.
"""
