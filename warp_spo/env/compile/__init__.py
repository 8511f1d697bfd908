"""How an environment's step becomes fused kernels: symbolic worlds, memory, buffers, CUDA graphs."""
