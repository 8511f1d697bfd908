"""How recursions run on a device: the plan, generated kernels, level-by-level launches, and the values kernels read."""
