"""Gradients of a step of a scene whose bodies touch: its passes once more, and then back through each of them.

The way back of the passes is :mod:`warp_spo.kernels.joint_adjoint`. It leaves gradients by points, by surfaces and by
screws of dofs, which go on to q through the narrow phase (:mod:`warp_spo.kernels.near_pairs_adjoint`) and through the
trace of the system. It also leaves, for each pass, a product of mass matrix and bias force, whose gradient is that of
inverse dynamics.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from ...errors import UnsupportedError
from ...execution.routine import Routine
from ...kernels import combination, joint_adjoint, joint_space, near_pairs_adjoint
from ...recursions.contact import joint_system
from ...recursions.contact.pairs import PASSES
from ...recursions.derivatives import joint_system as derivatives
from ...recursions.derivatives.adjoints import result_name
from ...runtime import launches
from .joint_space import JointSpaceStep

SYSTEM = Routine("joint_system_vjp", derivatives.joint_system_vjp)
STATE = Routine("joint_state_vjp", derivatives.joint_state_vjp)
POWER = Routine("joint_power_vjp", derivatives.joint_power_vjp)
LAWS = ("q", "qd", "tau", "target_q", "target_qd")  # arguments that the passes read themselves
STATES = ("q", "qd")  # the state before the step
ACTING = ("body_f", "ctrl", "target_q", "target_qd")
VALUES = ("contact_stiffness", "contact_damping", "contact_friction")
"""Values of a scene in which bodies touch by which steps have gradients."""


class JointSpaceGradients:
    """Gradients of the steps that a solver in joint space makes."""

    def __init__(self, solver: JointSpaceStep):
        self.solver, self.dyn = solver, solver.dyn
        self.device, self.worlds = solver.device, solver.worlds
        T: Any = solver.dyn.dtype
        sizes = solver.tables.sizes
        self.kernel = joint_adjoint.adjoint(sizes, T)
        near, pairs = solver.near_count, sizes.pairs
        self.narrow_phase_back = near_pairs_adjoint.narrow_phase_back(pairs, near, solver.routines)
        self.poses_back = near_pairs_adjoint.poses_back(pairs, near)
        self.to_float64, self.from_float64 = (
            near_pairs_adjoint.convert(*both) for both in ((T, wp.float64), (wp.float64, T))
        )
        self.wide: dict[str, wp.array] = {}
        self.wrenches = wp.zeros((self.worlds, 12 * near), dtype=wp.float64, device=self.device)
        wide: dict[int, wp.array] = {}
        constants = [solver.sides, *solver.shapes]
        for array in constants:
            if array.dtype is not wp.int32:
                wide[id(array)] = wp.array(array.numpy(), dtype=wp.float64, device=self.device)
        self.sides, *self.shapes = (wide.get(id(array), array) for array in constants)

    def _array(self, *key: Any) -> wp.array:
        """Return the array of a name, or of a name and numbers, with the shape that follows."""
        *name, shape = key
        return self.dyn.recursions.array(("way back in joint space", *name), *shape)

    def launch(self, results: dict[str, wp.array], passes: int | None, **given: Any) -> None:
        """Launch the gradients of a step into ``results`` by name.

        ``given``: arguments of the step, "qdd" that it found, and the cotangents of its results.
        """
        solver = self.solver
        if not set(results) <= {*LAWS, *ACTING, *VALUES}:
            way = f"ask for gradients by arguments of the step, and of values by {', '.join(VALUES)}"
            raise UnsupportedError("Dynamics.step, backwards", "another gradient where bodies touch each other", way)
        given = {name: value for name, value in given.items() if value is not None}
        q, qd, h, count = given["q"], given["qd"], given["dt"], PASSES if passes is None else int(passes)
        acting = {name: given.get(name) for name in ACTING}
        solver.find_system(q, qd, h, **acting)
        solver.find_points(h)
        sums: dict[str, list[wp.array]] = {name: [] for name in results}
        # the state after the passes
        passed = self._array("passed", qd.shape)
        self._combine(1.0, qd, h, given["qdd"], passed)
        seeds = {name: given[name] for name in ("q_cotangent", "qd_cotangent")}
        states = {name: self._array("state", name, given[name].shape) for name in STATES}
        states[joint_system.PASSED] = self._array("state", "passed", qd.shape)
        self._pull(STATE, states, q=q, qd=qd, dt=h, **{joint_system.PASSED: passed}, **seeds)
        # the passes
        solved, gains, found = self._passes_back(given, states[joint_system.PASSED], h, count)
        self._points_back(h, found["touches"], found[derivatives.POSES])
        # the system, which depends on the state
        inputs = {name: value for name, value in acting.items() if value is not None}
        if not solver.tables.sizes.laws:
            inputs = {name: value for name, value in inputs.items() if name == "body_f"}
        by_system = tuple(name for name in results if name in (*STATES, *inputs, *VALUES))
        systems = {name: self._array("system", name, results[name].shape) for name in by_system}
        options: dict[str, Any] = dict(pairs=tuple(solver.tables.pairs), motors=solver.motor_laws)
        options["surfaces"] = bool(solver.tables.sizes.surfaces)
        names = [joint_system.SCREWS, derivatives.POSES]
        names += [joint_system.SURFACES] * options["surfaces"]
        names += [joint_system.OF_MOTORS] * bool(solver.tables.sizes.laws)
        seeds = {f"{name}_bar": found[name] for name in names}
        self._pull(SYSTEM, systems, q=q, qd=qd, dt=h, **inputs, **seeds, **options)
        for source in (states, {name: found[name] for name in (*LAWS, *VALUES)}, systems):
            for name in results.keys() & source.keys():
                sums[name].append(source[name])
        for number in range(count):
            by_power = tuple(name for name in results if name in (*STATES, "body_f") and name in given)
            powers = {name: self._array("power", name, number, results[name].shape) for name in by_power}
            body_f = {"body_f": given["body_f"]} if "body_f" in given else {}
            self._pull(POWER, powers, q=q, qd=qd, qdd=gains[number], cotangent=solved[number], **body_f)
            for name, array in powers.items():
                sums[name].append(array)
        for name, array in results.items():
            self._add_up(sums[name], array)

    def _pull(self, routine: Routine, results: dict[str, wp.array], **given: Any) -> None:
        """Launch a product with a Jacobian into ``results``, by the arguments that they are named after."""
        if not results:
            return
        wrt = tuple(results)
        more = {result_name(name, wrt): results[name] for name in wrt[1:]}
        self.dyn._engine.launch_routine(routine, results[wrt[0]], more, wrt=wrt, **given)

    def _passes_back(
        self, given: dict[str, Any], cotangent: wp.array, h: float, count: int
    ) -> tuple[list[wp.array], list[wp.array], dict[str, wp.array]]:
        """Launch the passes and the way back; return what mass matrix and bias force are multiplied by, and gradients.

        These are by name: of arguments, and of what the passes read.
        """
        solver, sizes, dofs = self.solver, self.solver.tables.sizes, self.dyn.scene.dof_count
        optional = {"tau": solver.still, "target_q": solver.neutral, "target_qd": solver.still}
        tau, target_q, target_qd = (given.get(name, other) for name, other in optional.items())
        read = [solver.mass, solver.bias, tau, given["q"], given["qd"], target_q, target_qd, solver.screws, solver.near]
        read += [solver.touches, solver.surfaces, solver.motors, solver.dof_values, solver.pair_values, solver.place]
        size = joint_adjoint.work_size(sizes, count)
        work = self._array("passes", count, (self.worlds, size))
        solved, gains = (self._array(name, count, (self.worlds, count * dofs)) for name in ("solved", "gains"))
        shapes = {"tau": tau, "q": given["q"], "qd": given["qd"], "target_q": target_q, "target_qd": target_qd}
        shapes |= {"screws": solver.screws, "touches": solver.touches, "surfaces": solver.surfaces}
        found = {name: self._array("gradient", name, like.shape) for name, like in shapes.items()}
        found["motors"] = self._array("gradient", "motors", solver.motors.shape)
        found |= {name: self._array("gradient", name, (self.worlds, self.dyn.scene.contact_count)) for name in VALUES}
        found[derivatives.POSES] = self._array("gradient", "poses", solver.poses.shape)
        names = "tau", "q", "qd", "target_q", "target_qd", "screws", "touches", "surfaces", "motors", *VALUES
        threads = self.worlds * (joint_space.WARP if self.device.is_cuda else 1)
        inputs = [self.worlds, *read, h, float(count), cotangent]
        outputs = [work, solved, gains, *(found[name] for name in names)]
        launches.launch(self.kernel, threads, inputs, outputs, device=self.device, block_dim=joint_space.WARP)
        by_pass = [[self._array("of a pass", key, n, (self.worlds, dofs)) for n in range(count)] for key in (0, 1)]
        for whole, parts in zip((solved, gains), by_pass, strict=True):
            for number, part in enumerate(parts):
                rows_of = whole[:, number * dofs : (number + 1) * dofs]
                self._combine(1.0, rows_of, 0.0, rows_of, part)
        return by_pass[0], by_pass[1], found

    def _points_back(self, h: float, touches_bar: wp.array, poses_bar: wp.array) -> None:
        """Overwrite ``poses_bar``, the gradients by the poses of the bodies, from those by the points of near pairs."""
        solver = self.solver
        on: dict[str, Any] = {"device": self.device, "block_dim": 64}
        wide = {name: self._wide(name, array) for name, array in
                (("poses", solver.poses), ("velocities", solver.velocities), ("touches", solver.touches),
                 ("touches_bar", touches_bar))}  # fmt: skip
        slack = solver.margin + solver.gravity * h * h
        inputs = [self.worlds, wide["poses"], wide["velocities"], solver.which, self.sides, slack, h, *self.shapes]
        inputs += [solver.near, wide["touches"], wide["touches_bar"]]
        launches.launch(self.narrow_phase_back, solver.near_count * self.worlds, inputs, [self.wrenches], **on)
        found = self._wide("poses_bar", poses_bar, copy=False)
        inputs = [self.worlds, wide["poses"], solver.which, solver.near, self.wrenches]
        launches.launch(self.poses_back, self.worlds * poses_bar.shape[1], inputs, [found], **on)
        if found is not poses_bar:
            launches.launch(self.from_float64, found.size, [found.flatten()], [poses_bar.flatten()], **on)

    def _wide(self, name: str, array: wp.array, copy: bool = True) -> wp.array:
        """Return an array in float64, the array itself if it is one."""
        if array.dtype is wp.float64:
            return array
        if name not in self.wide:
            self.wide[name] = wp.zeros(array.shape, dtype=wp.float64, device=self.device)
        if copy:
            launches.launch(
                self.to_float64, array.size, [array.flatten()], [self.wide[name].flatten()], device=self.device
            )
        return self.wide[name]

    def _combine(self, a: float, x: wp.array, b: float, y: wp.array, out: wp.array) -> None:
        self.dyn.recursions.launch(combination.combine, out.shape, [a, x, b, y], [out])

    def _add_up(self, arrays: list[wp.array], out: wp.array) -> None:
        """Launch the sum of arrays of one shape, in this order."""
        shape = (self.worlds, out.size // self.worlds)
        flat, total = [array.reshape(shape) for array in arrays], out.reshape(shape)
        if not flat:
            launches.fill(out, 0)
            return
        self._combine(1.0, flat[0], 0.0, flat[0], total)
        for array in flat[1:]:
            self._combine(1.0, total, 1.0, array, total)
