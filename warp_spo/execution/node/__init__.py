"""Kernels at node granularity: one body a thread, a launch a level, or a scan along paths."""
