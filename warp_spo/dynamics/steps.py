"""Time steps: q and qd after dt, implicit in the hinges' springs, dampers, drives, limits and friction."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..arrays import Call
from ..errors import UnsupportedError, is_bool
from ..execution.sweeps import Sweeps
from ..gradients import check_plain
from ..kernels import combination, loops
from ..recursions.impedance import DEFAULT_BOUND
from ..recursions.loops.closed_step import NEWTON_STEPS
from ..scene.parts import real
from ..scene.scene import Scene
from .adjoints import differentiable

INTEGRATORS = ("semi_implicit", "midpoint", "rk4")
MIDPOINT_ITERATIONS = 6  # after the first guess; each gains an order in dt of the velocity terms
RK4 = ((0.0, 1.0 / 6.0), (0.5, 1.0 / 3.0), (0.5, 1.0 / 3.0), (1.0, 1.0 / 6.0))
"""Where each stage starts, in dt along the one before, and its weight."""
FORMATS = ((wp.float32, np.finfo(np.float32)), (wp.float64, np.finfo(np.float64)))
SECONDS: dict[Any, tuple[float, float]] = {dtype: (float(held.tiny), float(held.max)) for dtype, held in FORMATS}
"""Least and largest normal number of each dtype."""


class Steps:
    """What Dynamics inherits. Arrays and coordinates are as there."""

    scene: Scene
    worlds: int
    device: wp.Device
    dtype: type
    recursions: Sweeps

    @differentiable
    def step(
        self,
        q: Any,
        qd: Any,
        tau: Any,
        dt: float,
        body_f: Any = None,
        target_q: Any = None,
        target_qd: Any = None,
        integrator: str = "semi_implicit",
        qdd: Any = None,
        status: Any = None,
        out: Any = (None, None),
    ) -> tuple[Any, Any]:
        """The state after ``dt``: forward dynamics with the forces of all hinges, and q moved along the new qd.

        Forces on each dof, of the scene's values, f = 0 where they are zero; q' and qd' are the state after the step:

        * damping: -damping qd'. Spring: -stiffness (q' - rest), as in :meth:`passive_force`.
        * drive: target_ke (target_q - q') + target_kd (target_qd - qd'), not beyond the effort limit.
        * limits: limit_ke (limit - q') where q' is outside, and -limit_kd qd' where q is; they never pull inward.
          Of ball and free hinges: UnsupportedError.
        * dry friction: at most joint_friction against the motion; a hinge that sticks creeps by up to 1e-4 rad/s, m/s.
          In float32 one that stops from 10 rad/s within a step is held by up to 2 % more than that, at worst 10 %, in
          proportion to the rate: roundings of the rate are so much of the creep. In float64 by nothing.
        * velocity limit: a damper on what exceeds it, 300 / dt times the inertia that the hinge feels at the neutral q
          of world 0, all others being free: there what a step would exceed it by shrinks about three hundredfold, less
          where the hinge carries more. Of a hinge that feels none, 300 times what its other laws resist.

        Effort and velocity limits of 1e6 and more, Newton's default, bound nothing; position limits of 1e10 neither.
        What is zero or unbounded in the scene has no instruction in the kernel. The forces are implicit, at one
        addition to the mass matrix's diagonal: (Mass + dt R) qdd = tau - bias_force(q, qd) + F. Which parts of the
        laws hold is tried in passes, in one launch, until no force changes (16 at most).

        Where Dynamics closes loops, accelerations obey them, with all of the above on every dof, those that a loop
        moves among them; then q', and qd' there, take two of Newton's steps onto the closures, which leave
        O((h rate)^6), 1e-10 at 1 ms and 30 rad/s. An open state is drawn together in a few steps; ``project`` closes
        it at once. With loops embedded all of this is one kernel, and gradients are exact through rollouts: the way
        back onto the closures is part of them. loops="multipliers" takes a launch for each part, has no gradient, and
        no law that bends (limits, friction, effort and velocity limits): UnsupportedError.

        Args:
            q, qd: the state [world, coordinate], [world, dof].
            tau: forces dual to qd [world, dof]; None is zero.
            dt: length of the step [s], the same in all worlds. Not folded: changing it compiles nothing.
            body_f: as :meth:`forward_dynamics`.
            target_q, target_qd: targets of the drives, laid out as q and qd; None is the neutral q, and zero.
            integrator: "semi_implicit": order 1. "midpoint": implicit midpoint, order 2, the forces above implicit, the
                velocity terms by six fixed-point iterations, which diverge where a link turns by much of a radian in a
                step. "rk4": order 4, all explicit: stable only while
                (damping dt + stiffness dt^2) / inertia stays below 2, and only for scenes without friction and velocity
                limits.
            qdd: [world, dof], written with (qd' - qd) / dt of the semi-implicit step, before rounding it into qd' and
                before putting that onto the closures.
            status: int32 [world], of the semi-implicit step, written with the worst that is true of the world:

                * 2 = an input is NaN or infinite.
                * 1 = the result is not finite though the inputs are: as 1 and 4 in :meth:`forward_dynamics`. A hinge
                  that carries nothing, without armature, is where its forces cancel: NaN where no law can hold it, and
                  where its mass or armature is variable or differs between worlds.
                * 6 = the closures lose rank, or half of the dtype's digits: a change point, see there.
                * 7 = the closures are open after the step, or q' and qd' do not agree: by more than 1e-5 rad, 1e-5 of
                  the distance to the hinges that move the joint, or 1e-5 of the rates. The state stands: Newton's steps
                  did not take it back. Bars turn too far in the step (half a radian), which wants a shorter dt; or it
                  started open, see :meth:`project`; or angles of many turns, or places 100 m away, are rounded by as
                  much, which wants float64, full turns taken off, an origin nearby.
                * 5 = the last pass still found a law in another part than it had assumed: the step stands, with a force
                  that a shorter dt would correct.
                * 0 = none of these.
            out: (q, qd) after the step, each an array or None. They may be the arrays of the state itself.

        Returns:
            q [world, coordinate], quaternions normalised, and qd [world, dof].
        """
        with self._call("step") as call:
            if integrator not in INTEGRATORS:
                raise ValueError(f"{call.name}: integrator is {integrator!r}; expected one of {', '.join(INTEGRATORS)}")
            if not isinstance(out, tuple | list) or len(out) != 2:
                raise TypeError(f"{call.name}: out is {out!r}; expected a pair of arrays or None, (q, qd)")
            for name, array in (("status", status), ("qdd", qdd)):
                if array is not None and integrator != "semi_implicit":
                    raise ValueError(f"{call.name}: {name} with integrator={integrator!r}; expected 'semi_implicit'")
            dt = _seconds(call, dt)
            if not dt > 0.0:
                raise ValueError(f"{call.name}: dt is {dt} s; expected more than zero")
            q, qd = self._read_state(call, q, qd, optional=False)
            forces = {
                "tau": self._read_rate(call, "tau", tau),
                "body_f": self._read_body_f(call, body_f),
                "target_q": call.read("target_q", target_q, q.shape, "[world, coordinate]", optional=True),
                "target_qd": self._read_rate(call, "target_qd", target_qd),
            }
            qdd = call.update("qdd", qdd, (self.worlds, self.scene.dof_count), "[world, dof]")
            status = call.update("status", status, (self.worlds,), "[world]", dtype=wp.int32)
            q_out = call.write(out[0], q.shape, "[world, coordinate]", name="out[0]", over="q")
            qd_out = call.write(out[1], qd.shape, "[world, dof]", name="out[1]", over="qd")
            if integrator == "semi_implicit":
                self._step(q, qd, q_out, qd_out, dt, qdd, status, **forces)
            else:
                getattr(self, f"_{integrator}")(call, q, qd, q_out, qd_out, dt, **forces)
        return call.result

    def passive_force(self, q: Any, qd: Any = None, out: Any = None) -> Any:
        """-damping qd - stiffness (q - rest) [world, dof].

        For ball and free hinges, q - rest of the rotation is the rotation vector of R(q) R(rest)^T in the parent
        anchor's axes.
        """
        with self._call("passive_force") as call:
            q, qd = self._read_state(call, q, qd)
            out = call.write(out, (self.worlds, self.scene.dof_count), "[world, dof]")
            self._launch("passive_force", out, q=q, qd=qd)
        return call.result

    def body_accelerations(self, q: Any, qd: Any, qdd: Any, out: Any = None) -> Any:
        """Acceleration of every body's CoM [m/s^2], then angular acceleration [rad/s^2], inertial axes.

        Returns:
            [world, body, 6]: the time derivative of :meth:`body_velocities`.
        """
        with self._call("body_accelerations") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            qdd = self._read_rate(call, "qdd", qdd, optional=False)
            out = call.write(out, (self.worlds, self.scene.body_count, 6), "[world, body, 6]")
            self._launch("body_accelerations", out, q=q, qd=qd, qdd=qdd)
        return call.result

    def body_reactions(self, q: Any, qd: Any, qdd: Any, body_f: Any = None, out: Any = None) -> Any:
        """Wrench that each body receives through its hinge: force [N], then moment about its CoM [N m], inertial axes.

        It moves the body and all that it carries against gravity and ``body_f``, see :meth:`forward_dynamics`.
        Loops that are closed: UnsupportedError, for accelerations do not tell which of the hinges bears how much.

        Returns:
            [world, body, 6]
        """
        with self._call("body_reactions") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            qdd = self._read_rate(call, "qdd", qdd, optional=False)
            body_f = self._read_body_f(call, body_f)
            if self.scene.dof_count == 0:
                raise UnsupportedError(call.name, "a scene that cannot move", "add up the weights of its bodies")
            out = call.write(out, (self.worlds, self.scene.body_count, 6), "[world, body, 6]")
            self._launch("body_reactions", out, q=q, qd=qd, qdd=qdd, body_f=body_f)
        return call.result

    @differentiable
    def integrate(self, q: Any, qd: Any, dt: float, out: Any = None) -> Any:
        """q moved along a constant qd for dt [s] on the manifold, quaternions renormalised [world, coordinate].

        A free hinge's CoM moves straight while the body turns about it.
        """
        with self._call("integrate") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            out = call.write(out, (self.worlds, self.scene.coord_count), "[world, coordinate]")
            self._launch("integrate", out, q=q, qd=qd, dt=_seconds(call, dt))
        return call.result

    # -- integrators -----------------------------------------------------------------------------------------------
    def _step(
        self, q: Any, qd: Any, q_out: Any, qd_out: Any, dt: float, qdd: Any = None, status: Any = None, **given: Any
    ) -> None:
        asked = {name: array for name, array in (("qdd_out", qdd), ("status", status)) if array is not None}
        more = {"q_out": q_out, **asked}
        option = {name.removesuffix("_out"): True for name in asked}
        if self.scene.dof_count == 0 and status is not None:
            status.zero_()
        if self.closed and self.embedding is None:
            self._step_by_multipliers(q_out, qd_out, asked, option, q=q, qd=qd, dt=dt, **given)
            return
        self._launch("step", qd_out, more, q=q, qd=qd, dt=dt, how=self.embedding, **given, **option)

    def _step_by_multipliers(
        self, q_out: wp.array, qd_out: wp.array, asked: dict[str, wp.array], option: dict[str, Any], **given: Any
    ) -> None:
        """The multipliers, the open tree's step under them, and back onto the closures."""
        system, more = self._system()
        self._launch("step_system", system, more, **given)
        found, _, resolved = self._least_norm()
        q, qd = self._scratch("open q", q_out), self._scratch("open qd", qd_out)
        known = {"multipliers": found, **({"resolved": resolved} if "status" in option else {})}
        self._launch("step", qd, {"q_out": q, **asked}, **known, **given, **option)
        self._project(q, qd, False, NEWTON_STEPS, q_out, qd_out)
        if "status" in asked:
            left = self.recursions.array("closures open", self.worlds, 1)
            self._launch("closures_open", left, q=q_out, qd=qd_out)
            self.recursions.launch(loops.mark_open, self.worlds, [left], [asked["status"]])

    def _midpoint(self, call: Call, q: Any, qd: Any, q_out: Any, qd_out: Any, dt: float, **forces: Any) -> None:
        """The midpoint is a half step whose sweep and laws are taken at the midpoint itself."""
        q_at, qd_at, q_next, qd_next = (self._scratch(f"midpoint {i}", a) for i, a in enumerate((q, qd, q, qd)))
        self._step(q, qd, q_at, qd_at, 0.5 * dt, **forces)
        for _ in range(MIDPOINT_ITERATIONS):
            self._step(q_at, qd_at, q_next, qd_next, 0.5 * dt, q_from=q, qd_from=qd, **forces)
            q_at, qd_at, q_next, qd_next = q_next, qd_next, q_at, qd_at
        self._launch("integrate", q_next, q=q, qd=qd_at, dt=dt)
        self._combine(2.0, qd_at, -1.0, qd, qd_next)
        self._finish(q_next, qd_next, q_out, qd_out)

    def _rk4(
        self, call: Call, q: Any, qd: Any, q_out: Any, qd_out: Any, dt: float, tau: Any, body_f: Any, **targets: Any
    ) -> None:
        """Classical Runge-Kutta in the coordinates, quaternions included, which are normalised at the end."""
        values = self.scene.values
        if values["joint_friction"].any() or (abs(values["joint_velocity_limit"]) < DEFAULT_BOUND).any():
            raise UnsupportedError(call.name, "integrator='rk4' with friction or velocity limits", "use 'midpoint'")
        q_at, qd_at, q_sum, qd_sum = (self._scratch(f"rk4 {i}", a) for i, a in enumerate((q, qd, q, qd)))
        q_rate, qdd, force = (self._scratch(f"rk4 rate {i}", a) for i, a in enumerate((q, qd, qd)))
        for stage, (start, weight) in enumerate(RK4):
            if stage == 0:
                for array, at, total in ((q, q_at, q_sum), (qd, qd_at, qd_sum)):
                    wp.copy(at, array)
                    wp.copy(total, array)
            else:
                self._combine(1.0, q, start * dt, q_rate, q_at)
                self._combine(1.0, qd, start * dt, qdd, qd_at)
            self._launch("hinge_force", force, q=q_at, qd=qd_at, **targets)
            if tau is not None:
                self._combine(1.0, force, 1.0, tau, force)
            if self.closed:
                self._closed_forward_dynamics(qdd, None, q_at, qd_at, force, body_f)
            else:
                self._run("forward_dynamics", qdd, q=q_at, qd=qd_at, tau=force, body_f=body_f)
            self._launch("coordinate_rates", q_rate, q=q_at, qd=qd_at)
            self._combine(1.0, q_sum, weight * dt, q_rate, q_sum)
            self._combine(1.0, qd_sum, weight * dt, qdd, qd_sum)
        qdd.zero_()
        self._launch("integrate", q_at, q=q_sum, qd=qdd, dt=0.0)  # normalises
        self._finish(q_at, qd_sum, q_out, qd_out)

    def _finish(self, q: wp.array, qd: wp.array, q_out: wp.array, qd_out: wp.array) -> None:
        """The state after the step is q, qd, with its loops closed."""
        if self.closed:
            self._project(q, qd, False, NEWTON_STEPS, q_out, qd_out)
        else:
            wp.copy(q_out, q)
            wp.copy(qd_out, qd)

    def _scratch(self, name: str, like: wp.array) -> wp.array:
        return self.recursions.array(name, *like.shape)

    def _combine(self, a: float, x: wp.array, b: float, y: wp.array, out: wp.array) -> None:
        self.recursions.launch(combination.combine, out.shape, [a, x, b, y], [out])

    closed: bool
    embedding: Any
    _closed_forward_dynamics: Any
    _system: Any
    _least_norm: Any
    _project: Any
    _call: Any
    _read_state: Any
    _read_rate: Any
    _read_body_f: Any
    _run: Any
    _launch: Any


def _seconds(call: Call, dt: Any) -> float:
    name = call.name
    if isinstance(dt, float):
        seconds = float(dt)
    elif getattr(dt, "requires_grad", False):
        raise ValueError(f"{name}: dt requires grad; derivatives are not available through this call; pass float(dt)")
    else:
        check_plain(name, "dt", dt)
        try:
            number = real(dt)
            if number.ndim or is_bool(dt):
                raise TypeError
        except (TypeError, ValueError):
            raise TypeError(f"{name}: dt is {dt!r}; expected a number of seconds, the same in all worlds") from None
        seconds = float(number)
    least, most = SECONDS[call.dtype]
    if seconds != 0.0 and not least <= abs(seconds) <= most:
        raise ValueError(f"{name}: dt is {seconds} s; expected a number that {call.dtype.__name__} holds, finite")
    return seconds
