"""Every operation has a closed-loop version, or raises an error that names a way out."""

import numpy as np
import pytest

import warp_spo as spo
from support.mechanisms import MECHANISMS
from warp_spo.dynamics.dynamics import OPERATIONS
from warp_spo.dynamics.operation import AS_WRITTEN, Refused

OF_ALL_DOFS = {
    "forward_dynamics",
    "passive_force",
    "body_poses",
    "body_velocities",
    "body_states",
    "integrate",
    "frame_poses",
    "frame_velocities",
    "frame_accelerations",
    "body_accelerations",
    "com",
    "com_velocity",
    "kinetic_energy",
    "potential_energy",
    "difference",
    "interpolate",
    "closure_error",
    "project",
    "actuator_force",
}
"""Operations of all dofs, or of bodies, whether loops tie them or not."""
OF_OTHERS = {"operational_inertia", "forward_dynamics_derivatives", "loop_multipliers"}
"""Call operations that know of embedded loops, or raise by themselves."""
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
    "generalized_velocities",
    "quasi_velocity_force",
    "quasi_velocity_coriolis",
    "loop_multipliers",
    "inverse_dynamics_regressor",
    "inverse_dynamics_regressor_product",
    "inverse_dynamics_regressor_transposed_product",
}
"""Terms of the equation that multipliers solve, Mass qdd + bias_force = tau + Y* lambda of all dofs."""


BACKWARDS_OF_ALL_DOFS = {
    "body_poses",
    "body_velocities",
    "frame_poses",
    "frame_velocities",
    "frame_accelerations",
    "com",
    "com_velocity",
    "kinetic_energy",
    "potential_energy",
    "difference",
    "interpolate",
    "integrate",
    "actuator_force",
}


def test_declared_as_written_is_what_this_file_knows():
    """Nobody declares an operation right with closed loops without a thought: it is listed here, too."""
    written = {name for name, one in OPERATIONS.items() if one.embed is AS_WRITTEN}
    assert written == (OF_ALL_DOFS | OF_OTHERS) - {"forward_dynamics"}
    written = {name for name, one in OPERATIONS.items() if one.multipliers is AS_WRITTEN}
    assert written == OF_ALL_DOFS | OF_MULTIPLIERS | {"step", "operators"}
    derivatives = {name: one.derivative for name, one in OPERATIONS.items() if one.derivative is not None}
    for closed in ("embed", "multipliers"):
        written = {name for name, one in derivatives.items() if getattr(one, closed) is AS_WRITTEN}
        assert written == BACKWARDS_OF_ALL_DOFS


@pytest.mark.parametrize("how", ["embed", "multipliers"])
def test_no_operation_forgets_the_loops(how, device):
    """Each has a form, or it raises and names a way out."""
    dyn = spo.Dynamics(MECHANISMS["gripper"](), 1, device=device, loops=how)
    forms = {name: getattr(one, how) for name, one in OPERATIONS.items() if one.results}
    forms |= {f"{name}_vjp": getattr(one.derivative, how) for name, one in OPERATIONS.items() if one.derivative}
    refused = {name for name, form in forms.items() if isinstance(form, Refused)}
    refused |= {"loop_multipliers"} if how == "embed" else set()
    for operation in refused:
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
