"""Measurements, as ratios of things that run in turn in one process. Not part of the package."""
