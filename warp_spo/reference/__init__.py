"""The specification: dense float64 NumPy of one world. It imports NumPy and itself alone."""

from .dense import Dense as Dense
