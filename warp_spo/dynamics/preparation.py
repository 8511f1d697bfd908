"""Preparation: every kernel and array that an operation needs, ahead of its first call, by calling it with zeros."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..errors import as_integer, as_names
from ..scene.scene import Scene
from .adjoints import ARGUMENTS, OPTIONAL


class Takes(NamedTuple):
    """What a method of Dynamics takes.

    Attributes:
        given: names of what it always gets. if_asked: of arrays that it gets if an option of that name is true.
        options: names of what else ``prepare`` is asked for, and what there is otherwise.
    """

    given: str = "q"
    if_asked: str = ""
    options: dict[str, Any] = {}  # noqa: RUF012


FRAMES = {"frames": [0]}
TAKES = {
    "forward_dynamics": Takes("q qd tau", "body_f status"),
    "inverse_dynamics": Takes("q qd qdd", "body_f"),
    "mass_matrix": Takes(),
    "mass_matrix_inverse": Takes(),
    "solve_mass_matrix": Takes("q b", options={"columns": None}),
    "bias_force": Takes("q qd", "body_f"),
    "gravity_force": Takes(),
    "passive_force": Takes("q qd"),
    "log_det_mass_matrix": Takes(),
    "body_poses": Takes(),
    "body_velocities": Takes("q qd"),
    "body_states": Takes("q qd"),
    "jacobian": Takes(options=FRAMES),
    "operational_inertia_inverse": Takes(options=FRAMES),
    "integrate": Takes("q qd dt"),
    "hybrid_dynamics": Takes("q qd tau qdd", "body_f", {"prescribed": None}),
    "operational_inertia": Takes(options=FRAMES),
    "jacobian_bias": Takes("q qd", options=FRAMES),
    "frame_accelerations": Takes("q qd qdd", options=FRAMES),
    "operational_inertia_inverse_product": Takes("q x", options=FRAMES),
    "com_jacobian": Takes(),
    "centroidal_momentum_matrix": Takes(),
    "centroidal_momentum_bias": Takes("q qd"),
    "quasi_velocities": Takes("q qd"),
    "log_det_mass_matrix_gradient": Takes(),
    "fixman_torque": Takes(),
    "mass_matrix_packed": Takes(),
    "mass_matrix_inverse_packed": Takes(),
    "inverse_dynamics_derivatives": Takes("q qd qdd", "body_f"),
    "forward_dynamics_derivatives": Takes("q qd tau", "body_f"),
    "mass_matrix_derivative": Takes(),
    "step": Takes("q qd tau dt", "body_f target_q target_qd qdd status", {"integrator": "semi_implicit"}),
    "body_accelerations": Takes("q qd qdd"),
    "body_reactions": Takes("q qd qdd", "body_f"),
    "closure_error": Takes(),
    "project": Takes("q qd", options={"hold": False}),
    "loop_multipliers": Takes("q qd tau", "body_f"),
}
"""Every operation of Dynamics."""
PRODUCTS = (*(f"{operation}_vjp" for operation in ARGUMENTS), "forward_dynamics_jvp", "inverse_dynamics_jvp")
"""What else can be prepared."""
TIME = 1e-3  # [s], of steps that only compile


class Preparation:
    """What Dynamics inherits."""

    scene: Scene
    worlds: int
    device: wp.Device
    dtype: type

    def prepare(self, operation: str, **options: Any) -> None:
        """Compile and allocate all that ``operation`` needs, so that its next call only launches.

        Args:
            operation: name of a method, such as "forward_dynamics".
            options: ``frames=`` for operations that take frames, ``columns=`` for solve_mass_matrix, ``prescribed=``
                for hybrid_dynamics, ``integrator=`` for step, ``hold=`` for project, and ``body_f=True``,
                ``status=True``, ``qdd=True``, ``target_q=True``, ``target_qd=True`` if they will be given.

        Of the way back from an operation, torch's too, the name is "<operation>_vjp", such as "step_vjp", with ``wrt=``
        the names of arguments and then of values in their order; default: all arguments that are given. For
        "forward_dynamics_jvp" and "inverse_dynamics_jvp" ``along=`` names directions; default: all but "dbody_f".

        Raises:
            ValueError: no such operation or option.
        """
        if isinstance(operation, str) and operation in PRODUCTS:
            self._prepare_product(operation, options)
            return
        if not isinstance(operation, str) or operation not in TAKES:
            raise ValueError(f"Dynamics.prepare: no operation {operation!r}; expected one of {', '.join(TAKES)}")
        takes = TAKES[operation]
        asked = {name: options.pop(name, default) for name, default in takes.options.items()}
        names = [*takes.given.split(), *(name for name in takes.if_asked.split() if options.pop(name, False))]
        self._refuse_rest(operation, options)
        given = {name: self._stand_in(name, asked) for name in names}
        asked.pop("columns", None)
        if operation == "hybrid_dynamics" and asked["prescribed"] is None:
            asked["prescribed"] = [False] * self.scene.dof_count
        getattr(self, operation)(**given, **asked)

    def _stand_in(self, name: str, asked: dict[str, Any]) -> Any:
        """What an operation is called with: zeros, or the neutral coordinates."""
        if name == "dt":
            return TIME
        if name in ("q", "target_q"):
            return wp.array(np.tile(self.scene.neutral_q, (self.worlds, 1)), dtype=self.dtype, device=self.device)
        if name == "status":
            return wp.zeros(self.worlds, dtype=wp.int32, device=self.device)
        if name == "x":
            return self._zeros(self.worlds, 6 * len(asked["frames"]))
        if name == "b":
            if asked["columns"] is None:
                return self._zeros(self.worlds, self._minimal)
            columns = as_integer(asked["columns"])
            if columns is None or columns < 0:
                raise ValueError(
                    f"Dynamics.prepare: columns is {asked['columns']!r}; expected how many right-hand sides"
                )
            return self._zeros(self.worlds, self._minimal, columns)
        return self._zeros(*self._shape_of(name))

    def _zeros(self, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=self.dtype, device=self.device)

    def _prepare_product(self, product: str, options: dict[str, Any]) -> None:
        operation, way = product[:-4], product[-3:]
        wrt = as_names("Dynamics.prepare", "wrt", options.pop("wrt", ()) if way == "vjp" else (), ("q", "qd"))
        default = ("dq", "dqd", f"d{ARGUMENTS[operation][2]}") if way == "jvp" else ()
        along = as_names("Dynamics.prepare", "along", options.pop("along", default) if default else (), ("dq", "dqd"))
        for name in along:
            if name not in (*default, "dbody_f"):
                expected = ", ".join((*default, "dbody_f"))
                raise ValueError(f"Dynamics.prepare: along names {name!r} for {product}; expected some of {expected}")
        named = {*wrt, *(name[1:] for name in along)}
        given: dict[str, Any] = {
            name: self._stand_in(name, {"columns": None})
            for name in ARGUMENTS[operation]
            if name not in OPTIONAL or options.pop(name, name in named)
        }
        more: dict[str, Any] = {"frames": options.pop("frames", [0])} if operation == "jacobian" else {"dt": TIME}
        self._refuse_rest(product, options)
        if way == "jvp":
            rates = {name: self._zeros(*self._shape_of("body_f" if name == "dbody_f" else "qd")) for name in along}
            getattr(self, product)(**given, **rates)
            return
        results = [self._zeros(*shape) for shape in self.result_shapes(operation, **more)]
        if operation == "forward_dynamics":
            for qdd in (None, results[0]):
                self.forward_dynamics_vjp(**given, cotangent=results[0], qdd=qdd, wrt=wrt or tuple(given))
        else:
            cotangents = results[: 2 if operation == "step" else 1]
            self.pulled_back(operation, given, more, results, cotangents, wrt or tuple(given))

    @staticmethod
    def _refuse_rest(operation: str, options: dict[str, Any]) -> None:
        if options:
            raise ValueError(f"Dynamics.prepare: {operation} has no option {', '.join(options)}")

    _minimal: int
    _shape_of: Any
    forward_dynamics_vjp: Any
    pulled_back: Any
    result_shapes: Any
