"""Symbolic scalars: tracing with constant folding, differentiation, and emission of C++."""
