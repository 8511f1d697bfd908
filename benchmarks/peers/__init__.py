"""Peers: other libraries that are compared with the same reference and timed, on the same robots and states.

``python -m benchmarks.peers --help``. Each peer is optional: one that is not installed is skipped, with the reason.
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
"""Name on the command line -> module of this package whose ``PEER`` is the peer's class."""
