"""The stress suite: stiff and extreme scenes, each with a law for float32's error. ``python -m benchmarks.stress``."""
