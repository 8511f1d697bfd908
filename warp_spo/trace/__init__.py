"""Symbolic scalars: tracing with constant folding, derivatives, and C++ emission."""
