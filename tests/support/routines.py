"""Routines by name, for tests that look at kernels."""

from warp_spo.dynamics import forward_dynamics
from warp_spo.dynamics.dynamics import OPERATIONS

ROUTINES = {name: operation.routine for name, operation in OPERATIONS.items() if operation.routine is not None}
ROUTINES |= {f"{name}_vjp": one.derivative.routine for name, one in OPERATIONS.items() if one.derivative is not None}
ROUTINES |= {"forward_dynamics_and_solve": forward_dynamics.FORWARD_DYNAMICS_AND_SOLVE}
