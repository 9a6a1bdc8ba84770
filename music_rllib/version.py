"""Version of everything that determines what a training run computes."""

ALGORITHM_VERSION = "3"
"""Raised with every change of what is computed: nodes of older versions are not reused.

How sums are rounded is no part of it: that differs between CPUs and releases of PyTorch anyway, and
runs of different machines are compared with each other.
"""
