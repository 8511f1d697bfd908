"""Every operation has a closed-loop version, or raises an error that names a way out."""

import numpy as np
import pytest
from mechanisms import MECHANISMS

import warp_spo as spo
from warp_spo.dynamics import loops
from warp_spo.dynamics.adjoints import OF_TREE
from warp_spo.dynamics.preparation import PRODUCTS, TAKES

OF_ALL_DOFS = {
    "forward_dynamics",
    "passive_force",
    "body_poses",
    "body_velocities",
    "body_states",
    "integrate",
    "frame_accelerations",
    "body_accelerations",
    "closure_error",
    "project",
}
"""What speaks of all dofs, or of bodies, whatever ties them."""
OF_INVERSE = {"bias_force", "gravity_force", "bias_force_vjp", "gravity_force_vjp"}
OF_MULTIPLIERS = {
    "inverse_dynamics",
    "mass_matrix",
    "mass_matrix_inverse",
    "solve_mass_matrix",
    "bias_force",
    "gravity_force",
    "log_det_mass_matrix",
    "log_det_mass_matrix_gradient",
    "mass_matrix_packed",
    "mass_matrix_inverse_packed",
    "jacobian",
    "jacobian_bias",
    "com_jacobian",
    "centroidal_momentum_matrix",
    "centroidal_momentum_bias",
    "quasi_velocities",
    "loop_multipliers",
}
"""What multipliers are about is Mass qdd + bias_force = tau + Y* lambda of all dofs: these are its terms."""


@pytest.mark.parametrize("how", ["embed", "multipliers"])
def test_no_operation_forgets_the_loops(how, device):
    """Each is known here, embedded, of all dofs, or it raises and names a way out."""
    dyn = spo.Dynamics(MECHANISMS["gripper"](), 1, device=device, loops=how)
    of_tree = {f"{operation}_vjp" for operation in OF_TREE}
    known = (
        {
            "embed": {*loops.EMBEDDED, *OF_INVERSE, "operational_inertia", "forward_dynamics_derivatives"},
            "multipliers": OF_MULTIPLIERS,
        }[how]
        | OF_ALL_DOFS
        | of_tree
    )
    assert known <= {*TAKES, *PRODUCTS}
    for operation in {*TAKES, *PRODUCTS} - known - {"step"}:  # which has tests of its own
        with pytest.raises(spo.UnsupportedError, match=r"use|loops='cut'|loops='multipliers'|independent"):
            dyn.prepare(operation)
    q = np.zeros((1, dyn.scene.coord_count))
    if how == "embed":
        for pattern in ("mass_matrix_pattern", "mass_matrix_inverse_pattern"):
            with pytest.raises(spo.UnsupportedError, match="use mass_matrix"):
                getattr(dyn, pattern)
        with pytest.raises(spo.UnsupportedError, match="operators"):
            dyn.operators(q)
    else:
        with pytest.raises(spo.UnsupportedError, match=r"operational_inertia: .*use loops='embed'"):
            dyn.operational_inertia(q, [0])
