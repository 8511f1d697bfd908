"""Benchmarks: error and run time of every operation on a handful of robots. ``python -m benchmarks --help``."""
