"""Kernels at segment granularity: one warp a serial segment of the tree, in blocks of 32 worlds."""
