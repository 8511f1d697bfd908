"""Operations in which a mechanism agrees with its twin whose hinges are written in another way, and states of both."""

import numpy as np

from . import laws

AGREE = 1e-11  # float64, of the same mechanism written in two ways; conditioning of the draws
WORLDS = 3
FRAMES = ((1, (0.1, 0.2, -0.3)), (3, (0.0, 0.1, 0.0)))


def states(scene, seed=0):
    return {**laws.states(scene, WORLDS, seed), "dt": np.full((WORLDS, 1), 0.01)}


def difference(f, at, h=0.01):
    """d f along each dof of ``at(direction, step)``, by central differences of order 8; last index the dof."""
    columns = []
    for unit in np.eye(at(None, 0.0)):
        weighted = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
        columns.append(sum(c * (f(at(unit, i * h)) - f(at(unit, -i * h))) / h for i, c in weighted))
    return np.stack(columns, axis=-1)


def shapes(scene):
    n, c, b = scene.dof_count, scene.coord_count, scene.body_count
    rows = {"n": n, "c": c, "b": b, "f": len(FRAMES), "F": 6 * len(FRAMES)}
    return lambda text: tuple(rows.get(x) or int(x) for x in text)


SAME = {  # operation -> (arrays, {result: shape}, options)
    "forward_dynamics": ("q qd tau body_f", {"out": "n"}, {}),
    "inverse_dynamics": ("q qd qdd body_f", {"out": "n"}, {}),
    "mass_matrix": ("q", {"out": "nn"}, {}),
    "mass_matrix_inverse": ("q", {"out": "nn"}, {}),
    "log_det_mass_matrix_gradient": ("q", {"out": "n"}, {}),
    "inverse_dynamics_derivatives": ("q qd qdd body_f", {"out": "3nn"}, {}),
    "mass_matrix_derivative": ("q", {"out": "nnn"}, {}),
    "forward_dynamics_vjp": ("q qd tau cotangent", {"out": "c", "qd_bar": "n"}, {"wrt": ("q", "qd")}),
    "solve_mass_matrix_vjp": ("q b qdd cotangent", {"out": "c", "b_bar": "n"}, {"wrt": ("q", "b")}),
    "jacobian_vjp": ("q cotangent", {"out": "c"}, {"frames": FRAMES, "wrt": ("q",)}),
    "body_poses_vjp": ("q cotangent", {"out": "n"}, {"wrt": ("tangent",)}),
    "integrate_vjp": ("q qd dt cotangent", {"out": "c", "qd_bar": "n"}, {"wrt": ("q", "qd")}),
    "step_vjp": ("q qd tau qdd dt q_cotangent qd_cotangent", {"out": "c", "qd_bar": "n"}, {"wrt": ("q", "qd")}),
    "forward_dynamics_jvp": ("q qd tau qdd q_dot qd_dot tau_dot", {"out": "n"}, {}),
    "hybrid_dynamics": ("q qd tau qdd prescribed", {"out": "n", "tau_out": "n"}, {}),
    "jacobian": ("q", {"out": "f6n"}, {"frames": FRAMES}),
    "jacobian_bias": ("q qd", {"out": "f6"}, {"frames": FRAMES}),
    "operational_inertia_inverse": ("q", {"out": "FF"}, {"frames": FRAMES}),
    "body_velocities": ("q qd", {"out": "b6"}, {}),
    "body_accelerations": ("q qd qdd", {"out": "b6"}, {}),
    "body_reactions": ("q qd qdd", {"out": "b6"}, {}),
    "quasi_velocities": ("q qd", {"out": "n"}, {}),
    "quasi_velocity_coriolis": ("q nu", {"out": "n"}, {}),
    "centroidal_momentum_bias": ("q qd", {"out": "6"}, {}),
    "hinge_force": ("q qd", {"out": "n"}, {}),
    "integrate": ("q qd dt", {"out": "c"}, {}),
    "coordinate_rates": ("q qd", {"out": "c"}, {}),
}  # fmt: skip

LONG = ("mass_matrix_inverse", "solve_mass_matrix_vjp", "operational_inertia_inverse")
QUICK = [name for name in SAME if name not in LONG]
"""Operations of a quick run. The others take seconds and ask a hinge for nothing that these do not ask it for."""


def more_states(scene):
    a, rng = states(scene), np.random.default_rng(8)
    a["prescribed"] = np.tile(np.arange(scene.dof_count) % 2.0, (WORLDS, 1))
    a["b"], a["nu"] = a["b"][:, :, 0], a["qdd"]
    a |= {f"{name}_dot": rng.normal(size=a["tau"].shape) for name in ("q", "qd", "tau")}
    return a | {"q_cotangent": rng.normal(size=a["q"].shape), "qd_cotangent": rng.normal(size=a["qd"].shape)}
