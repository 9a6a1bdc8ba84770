"""Benchmarks: ratios of programs that run in turn in one process. Not part of the package."""
