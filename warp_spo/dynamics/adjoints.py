"""Products with Jacobians of the dynamics, J* y and J x: methods of :class:`warp_spo.Dynamics`.

No recording: forward dynamics is gone back through by its own solve and one Newton-Euler recursion backwards, in one
kernel, or in two where a warp works on a limb. Loops that are embedded: see :mod:`.recursions.embedded_adjoints`.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import warp as wp

from ..arrays import Call
from ..errors import UnsupportedError, as_names
from ..execution import link_values
from ..execution.plan import MOST_DOFS
from ..execution.programs import Programs
from ..execution.sweeps import Sweeps
from ..gradients import TensorValues, call_with_gradient, records_gradient
from ..recursions.links import LINK_VALUES
from ..scene.frames import check_frames
from ..scene.scene import Scene

ARGUMENTS = {
    "forward_dynamics": ("q", "qd", "tau", "body_f"),
    "inverse_dynamics": ("q", "qd", "qdd", "body_f"),
    "bias_force": ("q", "qd", "body_f"),
    "gravity_force": ("q",),
    "solve_mass_matrix": ("q", "b"),
    "mass_matrix": ("q",),
    "jacobian": ("q",),
    "body_poses": ("q",),
    "body_velocities": ("q", "qd"),
    "integrate": ("q", "qd"),
    "step": ("q", "qd", "tau", "body_f", "target_q", "target_qd"),
}
"""What each operation can be differentiated by, besides the values of the scene that vary."""
ANCHORS = ("joint_X_p", "joint_X_c")
GAINS = ("joint_damping", "joint_stiffness", "joint_friction", "joint_target_ke", "joint_target_kd")
ENTERING: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("jacobian", "body_poses", "body_velocities", "integrate"), (*ANCHORS, "body_com")),
    "step": (*LINK_VALUES, *GAINS),
}
"""Values that enter an operation, where they are not those that links are made of."""
OF_TREE = ("body_poses", "body_velocities", "integrate")
"""Operations that know nothing of loops, and have no use for them."""
EMBEDDED = ("forward_dynamics", "inverse_dynamics", "bias_force", "gravity_force", "step")
"""Operations of which there are products with the Jacobian where loops are embedded."""
OPTIONAL = ("body_f", "target_q", "target_qd")


def differentiable(method: Callable) -> Callable:
    """A method of Dynamics of which torch gets a result to go back through, where an input requires grad."""
    operation, signature = method.__name__, inspect.signature(method)

    @functools.wraps(method)
    def call(self: Any, *args: Any, **more: Any) -> Any:
        if not records_gradient((*args, *more.values()), self.values):
            return method(self, *args, **more)
        arguments = signature.bind(self, *args, **more).arguments
        del arguments["self"]
        return call_with_gradient(self, operation, method, arguments, ARGUMENTS[operation], self.entering(operation))

    return call


class Adjoints:
    """What Dynamics inherits. Arrays and coordinates are as there."""

    differentiable_by: ClassVar[dict[str, tuple[str, ...]]] = ARGUMENTS
    scene: Scene
    worlds: int
    device: wp.Device
    dtype: type
    variable: tuple[str, ...]
    recursions: Sweeps
    programs: Programs
    values: TensorValues
    closed: bool
    embedding: Any
    _minimal: int

    # -- backwards -------------------------------------------------------------------------------------------------
    def forward_dynamics_vjp(
        self,
        q: Any,
        qd: Any = None,
        tau: Any = None,
        body_f: Any = None,
        *,
        cotangent: Any,
        qdd: Any = None,
        wrt: Sequence[str] = ("q", "qd", "tau"),
        out: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Gradients of cotangent . qdd: J* cotangent of :meth:`forward_dynamics`, about twice its operations.

        With lambda = Mass^-1 cotangent, which the factors that give qdd give too, it is lambda for tau, and
        -(d tau / d x)* lambda, one Newton-Euler recursion in reverse, for everything else.

        Args:
            q, qd, tau, body_f: as there.
            cotangent: [world, dof].
            qdd: what forward_dynamics gives here, if it is known: saves computing it.
            wrt: names out of

                * "q": by the entries of the array, [world, coordinate]. Quaternions are normalised when read, so the
                  gradient by one is orthogonal to it.
                * "tangent": by q along its tangent coordinates, see :mod:`.derivatives`, [world, dof].
                * "qd", "tau", "body_f": of the array's shape; the last one must be given.
                * names in ``variable=`` out of body_mass, body_com, body_inertia, joint_X_p, joint_X_c, joint_armature,
                  gravity: [world, ...] in Newton's layout, for the value of each world. Entries of body_inertia are
                  taken as independent, of its symmetric part.
            out: results by name; those that are missing are made.

        Returns:
            The gradients by name. NaN in worlds where Mass has no inverse.

        With loops embedded, states come in consistent. The gradient is that of the function as it is computed, which
        goes on beside the closures, so that it has a part across them that no motion of the mechanism sees: its product
        with what they allow, X* times the gradient, is physical. lambda obeys the closures, whose own forces and
        accelerations add a solve of their rows.

        Raises:
            ValueError: a name that is none of these. UnsupportedError: more than 128 dof; loops by multipliers.
        """
        with self._call("forward_dynamics_vjp") as call:
            q, qd = self._read_state(call, q, qd)
            tau, body_f = self._read_rate(call, "tau", tau), self._read_body_f(call, body_f)
            cotangent = self._read_rate(call, "cotangent", cotangent, False)
            given = {"q": q, "qd": qd, "tau": tau, "body_f": body_f}
            names, outs = self._gradients(call, "forward_dynamics", given, wrt, out)
            given |= {"qdd": self._read_rate(call, "qdd", qdd), "cotangent": cotangent}
            self._pull_forward_dynamics(names, outs, given)
        return _by_name(names, call.result)

    def inverse_dynamics_vjp(
        self,
        q: Any,
        qd: Any = None,
        qdd: Any = None,
        body_f: Any = None,
        *,
        cotangent: Any,
        wrt: Sequence[str] = ("q", "qd", "qdd"),
        out: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Gradients of cotangent . tau: J* cotangent of :meth:`inverse_dynamics`, a recursion forwards, one in reverse.

        Args and returns: as :meth:`forward_dynamics_vjp`, with "qdd" for "tau"; it must be given if it is in ``wrt``.
        With loops embedded cotangent is [world, independent dof], and the gradient by qdd zero at other dofs.
        """
        with self._call("inverse_dynamics_vjp") as call:
            q, qd = self._read_state(call, q, qd)
            qdd, body_f = self._read_rate(call, "qdd", qdd), self._read_body_f(call, body_f)
            cotangent = call.read("cotangent", cotangent, (self.worlds, self._minimal), "[world, dof]")
            given = {"q": q, "qd": qd, "qdd": qdd, "body_f": body_f}
            names, outs = self._gradients(call, "inverse_dynamics", given, wrt, out)
            self._pull("inverse_dynamics", names, outs, {**given, "cotangent": cotangent})
        return _by_name(names, call.result)

    # -- forwards --------------------------------------------------------------------------------------------------
    def forward_dynamics_jvp(
        self,
        q: Any,
        qd: Any = None,
        tau: Any = None,
        body_f: Any = None,
        *,
        dq: Any = None,
        dqd: Any = None,
        dtau: Any = None,
        dbody_f: Any = None,
        qdd: Any = None,
        out: Any = None,
    ) -> Any:
        """How qdd changes along a direction: J (dq, dqd, dtau, dbody_f) of :meth:`forward_dynamics`, in one kernel.

        Args:
            q, qd, tau, body_f: as there. dq: along tangent coordinates [world, dof], see :mod:`.derivatives`.
            dqd, dtau, dbody_f: of the arrays' shapes. None is zero and costs nothing.
            qdd: what forward_dynamics gives here, if it is known: saves computing it.

        With loops embedded, directions may leave what the closures allow; see :meth:`forward_dynamics_vjp`.

        Returns:
            [world, dof]
        """
        with self._call("forward_dynamics_jvp") as call:
            q, qd = self._read_state(call, q, qd)
            given = {"q": q, "qd": qd, "tau": self._read_rate(call, "tau", tau)}
            given["body_f"] = self._read_body_f(call, body_f)
            qdd = self._accelerations(self._read_rate(call, "qdd", qdd), given)
            if self.embedding is None:
                del given["tau"]
            self._push(call, "forward_dynamics", {**given, "qdd": qdd}, dq, dqd, ("tau", dtau), dbody_f, out)
        return call.result

    def inverse_dynamics_jvp(
        self,
        q: Any,
        qd: Any = None,
        qdd: Any = None,
        body_f: Any = None,
        *,
        dq: Any = None,
        dqd: Any = None,
        dqdd: Any = None,
        dbody_f: Any = None,
        out: Any = None,
    ) -> Any:
        """How tau changes along a direction; as :meth:`forward_dynamics_jvp`, with dqdd for dtau [world, dof].

        With loops embedded [world, independent dof].
        """
        with self._call("inverse_dynamics_jvp") as call:
            q, qd = self._read_state(call, q, qd)
            given = {"q": q, "qd": qd, "qdd": self._read_rate(call, "qdd", qdd)}
            given["body_f"] = self._read_body_f(call, body_f)
            self._push(call, "inverse_dynamics", given, dq, dqd, ("qdd", dqdd), dbody_f, out)
        return call.result

    # -- torch -----------------------------------------------------------------------------------------------------
    @property
    def differentiable_values(self) -> tuple[str, ...]:
        """Names of the variable values by which results can be differentiated."""
        return tuple(name for name in ENTERING["step"] if name in self.variable)

    def result_shapes(self, operation: str, frames: Sequence[Any] = (), **_: Any) -> tuple[tuple[int, ...], ...]:
        """Shapes of what an operation gives, with its options, and of what its way back needs besides."""
        scene, worlds = self.scene, self.worlds
        q, rate = (worlds, scene.coord_count), (worlds, scene.dof_count)
        shapes: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("inverse_dynamics", "bias_force", "gravity_force"), (worlds, self._minimal)),
            "body_poses": (worlds, scene.body_count, 7),
            "body_velocities": (worlds, scene.body_count, 6),
            "mass_matrix": (*rate, scene.dof_count),
            "jacobian": (worlds, len(frames), 6, scene.dof_count),
        }
        if operation == "step":
            return q, rate, rate
        return (q if operation == "integrate" else shapes.get(operation, rate),)

    def check_gradient(self, operation: str) -> None:
        """Raise UnsupportedError where an operation has no gradient on this scene."""
        call = self._call(f"{operation}, backwards")
        self._check_size(call, operation)
        if operation == "body_poses" and self.scene.dof_count and self.programs.links.turns_vary:
            what = "the gradient of poses where anchors vary"
            raise UnsupportedError(call.name, what, "keep joint_X_p and joint_X_c folded")

    def entering(self, operation: str) -> tuple[str, ...]:
        """Names of the values that enter an operation."""
        return ENTERING.get(operation, LINK_VALUES)

    def pulled_back(
        self,
        operation: str,
        given: dict[str, Any],
        options: dict[str, Any],
        results: Sequence[Any],
        cotangents: Sequence[Any],
        wrt: Sequence[str],
    ) -> dict[str, Any]:
        """Gradients by name of a call with the arguments ``given``, for the ``cotangents`` of its ``results``."""
        if operation == "step":
            return self._step_pulled_back(given, options, results, cotangents, wrt)
        (result,), (cotangent,) = results, cotangents
        if operation == "forward_dynamics":
            return self.forward_dynamics_vjp(**given, cotangent=cotangent, qdd=result, wrt=wrt)
        if operation in ("inverse_dynamics", "bias_force", "gravity_force"):
            return self.inverse_dynamics_vjp(**given, cotangent=cotangent, wrt=wrt)
        if operation == "solve_mass_matrix" and result.ndim == 3:
            return self._of_columns(given, result, cotangent, wrt)
        shape = tuple(result.shape)
        with self._call(f"{operation}, backwards") as call:
            q, qd = self._read_state(call, given["q"], given.get("qd"))
            arrays = {"q": q, "qd": qd, "cotangent": call.read("cotangent", cotangent, shape)}
            if operation == "integrate":
                arrays["dt"] = float(options["dt"])
            if operation == "solve_mass_matrix":
                arrays["qdd"] = call.read("result", result, shape)
            if operation == "jacobian":
                arrays["frames"] = check_frames(self.scene, call.name, options["frames"])
            names, outs = self._gradients(call, operation, {}, wrt, None)
            self._pull(operation, names, outs, arrays)
        return _by_name(names, call.result)

    def _step_pulled_back(
        self,
        given: dict[str, Any],
        options: dict[str, Any],
        results: Sequence[Any],
        cotangents: Sequence[Any],
        wrt: Sequence[str],
    ) -> dict[str, Any]:
        """Of a step; ``results`` are the new state and the accelerations."""
        with self._call("step, backwards") as call:
            arrays: dict[str, Any] = {"dt": float(options["dt"])}
            for name, array in given.items():
                arrays[name] = call.read(name, array, self._shape_of(name))
            arrays["qdd"] = self._read_rate(call, "qdd", results[2], False)
            for name, like, array in zip(("q_cotangent", "qd_cotangent"), ("q", "qd"), cotangents, strict=True):
                arrays[name] = call.read(name, array, self._shape_of(like))
            names, outs = self._gradients(call, "step", arrays, wrt, None)
            if self.embedding is None:
                arrays.pop("tau", None)
            self._pull("step", names, outs, arrays)
        return _by_name(names, call.result)

    def _of_columns(self, given: dict[str, Any], result: Any, cotangent: Any, wrt: Sequence[str]) -> dict[str, Any]:
        """Gradients of solve_mass_matrix with several right-hand sides, torch tensors, one after the other."""
        found: dict[str, Any] = {}
        for c in range(result.shape[2]):
            one = (result[..., c].contiguous(),), (cotangent[..., c].contiguous(),)
            for name, gradient in self.pulled_back("solve_mass_matrix", given, {}, *one, wrt).items():
                if name != "b":
                    found[name] = found[name] + gradient if name in found else gradient
                else:
                    found.setdefault("b", result.clone())[..., c] = gradient
        return found

    @contextlib.contextmanager
    def held(self, values: dict[str, Any]) -> Iterator[None]:
        """The scene's values are these inside the block, and what they were behind it."""
        if not values:
            yield
            return
        parameters = self.recursions.parameters
        with Call("Dynamics.set", self.device, self.dtype) as call:
            taken, before = {}, {}
            for name, value in values.items():
                shape = self.scene.values[name].shape[1:]
                taken[name] = call.read(name, value, (self.worlds, *shape) if value.ndim > len(shape) else shape)
            for name, array in taken.items():  # on the stream that read has entered
                before[name] = wp.clone(parameters.value(name))
                parameters.copy_in(name, array)
            parameters.refresh(values)
            try:
                yield
            finally:
                for name, value in before.items():
                    wp.copy(parameters.value(name), value)
                parameters.refresh(values)

    # -- steps -----------------------------------------------------------------------------------------------------
    def _push(
        self, call: Call, operation: str, given: dict, dq: Any, dqd: Any, third: tuple, dbody_f: Any, out: Any
    ) -> None:
        rates = (("q_dot", "dq", dq), ("qd_dot", "dqd", dqd), (f"{third[0]}_dot", f"d{third[0]}", third[1]))
        arrays = given | {array: self._read_rate(call, name, value) for array, name, value in rates}
        shape = (self.worlds, self.scene.body_count, 6)
        arrays["body_f_dot"] = call.read("dbody_f", dbody_f, shape, "[world, body, 6]", optional=True)
        for array, what in (("qd", "qd_dot"), ("qdd", "qdd_dot"), ("body_f", "body_f_dot")):
            if arrays.get(array) is None and arrays.get(what) is not None:
                raise ValueError(f"{call.name}: d{array} is given and {array} is None; expected both; pass zeros")
        self._check_size(call, operation)
        rows = self._minimal if operation == "inverse_dynamics" else self.scene.dof_count
        result = call.write(out, (self.worlds, rows), "[world, dof]")
        self._launch(f"{operation}_jvp", result, **arrays)

    def _accelerations(self, qdd: Any, given: dict[str, Any]) -> Any:
        """``qdd``, or what forward dynamics makes it."""
        if qdd is None and self.scene.dof_count:
            qdd = self.recursions.array("qdd of derivatives", self.worlds, self.scene.dof_count)
            if self.embedding is None:
                self._run("forward_dynamics", qdd, **given)
            else:
                self._closed_forward_dynamics(qdd, None, **given)
        return qdd

    def _gradients(
        self, call: Call, operation: str, given: dict[str, Any], wrt: Sequence[str], out: dict[str, Any] | None
    ) -> tuple[tuple[str, ...], list[wp.array]]:
        """The checked names, and an array for each."""
        self._check_size(call, operation)
        names = as_names(call.name, "wrt", wrt, ARGUMENTS[operation][:2])
        if not isinstance(out, Mapping | None):
            raise TypeError(f"{call.name}: out is of type {type(out).__name__}; expected a dict, arrays by name of wrt")
        out = out or {}
        arguments = ARGUMENTS[operation]
        entering = self.entering(operation)
        known = (*arguments[:1], "tangent", *arguments[1:], *(name for name in entering if self._varies(name)))
        for name in names:
            if name in entering and name not in known:
                way = f"build Dynamics with variable=({name!r},)"
                raise ValueError(f"{call.name}: wrt names {name!r}, which is folded into the kernels; {way}")
            if name not in known:
                raise ValueError(f"{call.name}: wrt names {name!r}; expected some of {', '.join(known)}")
            if name in given and given[name] is None and name != "tau":
                raise ValueError(f"{call.name}: wrt names {name!r}, which is None; pass zeros to differentiate by it")
        if not names or len(set(names)) < len(names):
            raise ValueError(f"{call.name}: wrt is {names!r}; expected one name or more, each once")
        for name in out:
            if name not in names:
                raise ValueError(f"{call.name}: out has {name!r}; expected names out of wrt: {', '.join(names)}")
        shapes = {name: self._shape_of(name) for name in names}
        return names, [call.write(out.get(n), shapes[n], f"[world, ...] like {n}", name=f"out[{n!r}]") for n in names]

    def _varies(self, name: str) -> bool:
        return name in self.variable or self.scene.values[name].shape[0] > 1

    def _shape_of(self, name: str) -> tuple[int, ...]:
        scene = self.scene
        if name in (*LINK_VALUES, *GAINS):
            return self.worlds, *scene.values[name].shape[1:]
        q = (scene.coord_count,)
        shapes: dict[str, tuple] = {"q": q, "target_q": q, "body_f": (scene.body_count, 6)}
        return self.worlds, *shapes.get(name, (scene.dof_count,))

    def _pull(self, operation: str, names: tuple[str, ...], outs: Sequence[wp.array], given: dict[str, Any]) -> None:
        """Launch the reverse of an operation; values of the scene follow from those of the links."""
        results = dict(zip(names, outs, strict=True))
        values = {name: results.pop(name) for name in names if name in LINK_VALUES}
        if self.scene.dof_count == 0:
            for array in outs:
                array.zero_()
            return
        if values:
            self.programs.links.opened()  # which fills the table
            size = len(self.programs.links.tables["value"])
            results["value"] = self.recursions.array("value of derivatives", self.worlds, size)
        first, *more = results
        further = {f"{name}_bar": results[name] for name in more}
        self._launch(f"{operation}_vjp", results[first], further, wrt=tuple(results), **given)
        if values:
            flat = {name: array.reshape((self.worlds, math.prod(array.shape[1:]))) for name, array in values.items()}
            link_values.pull_back(self.recursions.parameters, self.programs.links, results["value"], flat)

    def _pull_forward_dynamics(self, names: tuple[str, ...], outs: Sequence[wp.array], given: dict[str, Any]) -> None:
        """In one kernel; where a warp works on a limb, in one for qdd and lambda and another one for what follows."""
        qdd, cotangent = given["qdd"], given["cotangent"]
        state = {name: given[name] for name in ("q", "qd", "body_f")}
        if self.embedding is not None:  # whose closures bear what tau leaves, too
            arrays = {**state, "tau": given["tau"]}
            self._pull("forward_dynamics", names, outs, {**given, "qdd": self._accelerations(qdd, arrays)})
            return
        forces = {"tau": given["tau"]} if qdd is None else {"qdd": qdd}
        if self.scene.dof_count == 0 or self.programs.plan.of("forward_dynamics_vjp") != "segment":
            self._pull("forward_dynamics", names, outs, {**state, **forces, "cotangent": cotangent})
            return
        results, shape = dict(zip(names, outs, strict=True)), (self.worlds, self.scene.dof_count)
        solved = results.pop("tau", None)
        if solved is None:
            solved = self.recursions.array("lambda of derivatives", *shape)
        if qdd is None and results:
            qdd = self.recursions.array("qdd of derivatives", *shape)
            self._launch("forward_dynamics_and_solve", qdd, {"solved": solved}, **state, **forces, cotangent=cotangent)
        else:
            self._run("solve_mass_matrix", solved, q=given["q"], b=cotangent)
        if results:
            self._pull("forward_dynamics", tuple(results), [*results.values()], {**state, "qdd": qdd, "solved": solved})

    def _check_size(self, call: Call, operation: str = "") -> None:
        """``operation``: whose derivative is a product."""
        if self.closed and operation not in (*OF_TREE, *(EMBEDDED if self.embedding is not None else ())):
            way = "loops='cut' leaves them open"
            if operation in EMBEDDED:
                way = f"use loops='embed'; {way}"
            raise UnsupportedError(call.name, "a derivative with closed loops", way)
        if self.scene.dof_count > MOST_DOFS:
            what = f"a scene of {self.scene.dof_count} dof"
            raise UnsupportedError(call.name, what, f"derivatives are straight-line code, of up to {MOST_DOFS} dof")

    _call: Any
    _read_state: Any
    _read_rate: Any
    _read_body_f: Any
    _run: Any
    _launch: Any
    _closed_forward_dynamics: Any


def _by_name(names: tuple[str, ...], results: Any) -> dict[str, Any]:
    return dict(zip(names, results if len(names) > 1 else (results,), strict=True))
