"""Peers on the same robots and states: other libraries timed and checked as the benchmarks time and check this one.

``python -m benchmarks.peers --help``. Each peer is optional: one that is absent is skipped, with the reason printed.
"""

PEERS = {
    "mujoco_warp": "mujoco_gpu",
    "newton": "newton_solvers",
    "grid": "grid",
    "frax": "frax_jax",
    "torch": "torch_dense",
    "resolvent": "torch_resolvent",
    "pinocchio": "pinocchio_cpu",
    "mujoco": "mujoco_c",
}
"""Name on the command line -> module of this package, whose ``PEER`` it is."""
