"""Version of everything that determines what a training run computes."""

ALGORITHM_VERSION = "2"
"""Raised with every change that alters a run's numbers: nodes of older versions are not reused."""
