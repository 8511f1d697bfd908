"""Tracing: step functions run once on symbolic scalars, and what remains of a scene becomes straight-line code."""
