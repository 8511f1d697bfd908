"""How recursions run on a device: the plan, generated kernels, launches a level, and the values that kernels read."""
