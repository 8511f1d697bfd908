"""The declaration of an operation of :class:`warp_spo.Dynamics`: one object, from which everything else derives.

An :class:`Operation` stands right above the method that it declares::

    MASS_MATRIX = Operation(
        "mass_matrix",
        arguments=(Q,),
        results=(Result("mass", "world, independent dof, independent dof"),),
        routine=Routine(
            "mass_matrix",
            composite.mass_matrix,
            nodes.mass_matrix,
            segments=SegmentForm(messages="R"),
            hints=TuningHints(long_result=True),
        ),
        embed=Routine("embedded_mass_matrix", minimal.mass_matrix),
        multipliers=AS_WRITTEN,
        trial=Trial(lambda dense, q: dense.mass_matrix),
    )


    @MASS_MATRIX.method
    def mass_matrix(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
        return self._engine.run(MASS_MATRIX, out, q=q)

and ``mass_matrix = inertia.mass_matrix`` is its line in the class. Checks of arguments, refusals with closed loops,
``prepare``, gradients in torch, trials, the main job's table and the benchmarks read the declaration.

An operation of many arguments has ``bundles``: objects that hold some of them. Its method takes all by their own names
and is called ``_step``, and ``@STEP.public`` stands above the signature that users see.

Axes are written as words: "world, dof". The words are "world", "coordinate", "dof", "independent dof" (the dofs that
move all others where loops are embedded, otherwise all dofs), "body", "frame", "6 frames" (six for each frame), "10
bodies", "row" (of the closures of loops), "actuator", "contact" (each point), "entry" (of a packed matrix), and
numbers.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, cast

import numpy as np
import warp as wp

from ..execution.routine import Routine
from ..recursions.model.links import LINK_VALUES, MOTION_VALUES, Links
from ..runtime.arrays import Call
from ..runtime.dlpack import settle
from ..scene.contact_values import CONTACT_VALUES
from ..scene.frames import check_frames, origins
from ..scene.ground import HEIGHTS
from ..scene.scene import Scene
from . import trial_inputs
from .call_replay import MISS, dispatch

if TYPE_CHECKING:
    from .gradients import Pull
from ..errors import as_names, is_bool
from ..runtime.autograd import check_plain
from ..scene.parts import real

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


# -- arguments and results ---------------------------------------------------------------------------------------------
@dataclasses.dataclass(frozen=True)
class Argument:
    """An array that an operation takes.

    Attributes:
        name: name of the argument. axes: its axes in words.
        optional: None is allowed; it means zero and costs nothing.
        asked: ``prepare`` passes the array only where it is asked for by name.
        written: the call fills the array. dtype: scalar type; None is that of the Dynamics.
        columns: a further axis may hold several right-hand sides.
        number: a number is allowed, too, the same in all worlds.
        direction: the argument is the direction of a derivative by the argument without the first letter, "dq" by "q".
        sample: name of the random input that trials pass, see :class:`warp_spo.trials.inputs.Inputs`.
    """

    name: str
    axes: str
    optional: bool = False
    asked: bool = False
    written: bool = False
    dtype: type | None = None
    columns: bool = False
    number: bool = False
    direction: bool = False
    sample: str = ""


@dataclasses.dataclass(frozen=True)
class Option:
    """An argument that is not an array.

    Attributes:
        name: name of the argument.
        read: ``read(scene, call, value)`` returns what the routine gets; None: the method reads the value itself.
        default: ``default(scene)``, what ``prepare`` passes.
        in_prepare: it is an option of ``prepare``, too.
        stand_in: ``stand_in(dyn, given)``, what ``prepare`` passes beside the arguments ``given``; None: the default.
        sample: ``sample(scene)``, what trials pass; None: nothing.
    """

    name: str
    read: Callable[[Scene, Call, Any], Any] | None = None
    default: Callable[[Scene], Any] = lambda scene: None
    in_prepare: bool = True
    sample: Callable[[Scene], Any] | None = None
    stand_in: Callable[[Any, dict[str, Any]], Any] | None = None


@dataclasses.dataclass(frozen=True)
class Result:
    """An array that an operation returns.

    Attributes:
        name: name among the results. axes: its axes in words. dtype: scalar type; None is that of the Dynamics.
        like: name of the argument whose shape the result has, where that is not settled by the scene.
        over: name of the argument whose very array ``out=`` may be.
        quaternions: ``quaternions(scene)``, first entry of each quaternion of a world's flat result; q and -q are the
            same rotation.
    """

    name: str
    axes: str
    dtype: type | None = None
    like: str = ""
    over: str = ""
    quaternions: Callable[[Scene], list[int]] = lambda scene: []


@dataclasses.dataclass(frozen=True)
class Bundle:
    """Arguments that callers pass in one object.

    Attributes:
        name: of the argument that takes the object. members: names of the arguments in it.
        expand: ``expand(call, value)`` returns the members of an object by name, those that differ from their defaults.
        form: how a caller passes a member, for errors; ``{name}`` stands for its name.
        written: the members are arrays that the call fills; ``prepare`` takes their names.
    """

    name: str
    members: tuple[str, ...]
    expand: Callable[[str, Any], dict[str, Any]]
    form: str
    written: bool = False

    def ask(self, call: str, value: Any) -> dict[str, Any]:
        """Return the members by name that ``prepare`` passes; arrays that the call fills are named, and True.

        Raises:
            TypeError: the value is not such an object, or such names. ValueError: there is no such array.
        """
        if not self.written:
            return self.expand(call, value)
        names = as_names(call, self.name, value, self.members[-1:])
        for name in names:
            if name not in self.members:
                known = ", ".join(self.members)
                raise ValueError(f"{call}: {self.name} names {name!r}; expected some of {known}")
        return dict.fromkeys(names, True)

    def refuse(self, call: str, name: str, in_prepare: bool = False) -> NoReturn:
        """Raise TypeError for a member that is given by itself; ``in_prepare``: to ``prepare``."""
        form = f'{self.name}=("{name}",)' if in_prepare and self.written else self.form.format(name=name)
        raise TypeError(f"{call}: {name}= is no argument; expected {form}")


def required(argument: Argument) -> Argument:
    """Return the argument without the choice of None, so that ``prepare`` passes it always."""
    return dataclasses.replace(argument, optional=False, asked=False)


def direction(argument: Argument) -> Argument:
    """Return the argument for a direction of a derivative by another argument."""
    return dataclasses.replace(argument, name=f"d{argument.name}", optional=True, direction=True)


Q = Argument("q", "world, coordinate")
QD = Argument("qd", "world, dof", optional=True)
QDD = Argument("qdd", "world, dof", optional=True)
TAU = Argument("tau", "world, dof", optional=True)
BODY_F = Argument("body_f", "world, body, 6", optional=True, asked=True)
CTRL = Argument("ctrl", "world, actuator", optional=True, asked=True)
STATUS = Argument("status", "world", optional=True, asked=True, written=True, dtype=wp.int32)
ORIENTED_FRAMES = Option(
    "frames",
    lambda scene, call, frames: check_frames(scene, call.name, frames),
    lambda scene: [0],
    sample=trial_inputs.two_frames,
)
FRAMES = dataclasses.replace(
    ORIENTED_FRAMES,
    read=lambda scene, call, frames: origins(check_frames(scene, call.name, frames)),  # their axes do not enter
)
DT = Option(
    "dt", lambda scene, call, dt: seconds(call, dt), lambda scene: STAND_IN, False, lambda scene: trial_inputs.DT
)


# -- closed loops ------------------------------------------------------------------------------------------------------
class AsWritten:
    """The method is right with closed loops as it is written.

    Either it speaks of bodies, or of all dofs whatever ties them, or it calls operations that know of loops.
    """


@dataclasses.dataclass(frozen=True)
class Refused:
    """The operation raises UnsupportedError with closed loops.

    Attributes:
        way_out: what a user can do instead, beside ``loops="cut"``.
        what: what is not supported, for the error; "": the value of ``loops=``.
    """

    way_out: str = ""
    what: str = ""


AS_WRITTEN = AsWritten()
USE_EMBED = Refused("use loops='embed'")
NO_DERIVATIVE = Refused(what="a derivative with closed loops")
EMBEDDED_DERIVATIVE = dataclasses.replace(NO_DERIVATIVE, way_out="use loops='embed'")
Closed = Routine | AsWritten | Refused
"""Closed-loop form of an operation. A Routine is its form in the independent dofs, where loops are embedded."""


# -- derivatives -------------------------------------------------------------------------------------------------------
ANCHORS = ("joint_X_p", "joint_X_c")
GAINS = ("joint_damping", "joint_stiffness", "joint_friction", "joint_target_ke", "joint_target_kd", "joint_rest_q",
         "joint_limit_lower", "joint_limit_upper", "joint_limit_ke", "joint_limit_kd", "joint_effort_limit",
         "joint_velocity_limit")  # fmt: skip
KINEMATIC = (*ANCHORS, "body_com")  # values that enter poses, velocities and Jacobians
ACTUATION = ("actuator_gain", "actuator_bias", "actuator_gear", "actuator_strength")
DIFFERENTIABLE = (*LINK_VALUES, *GAINS, *ACTUATION, *CONTACT_VALUES, "ground_origin",
                  HEIGHTS)  # fmt: skip
"""All values of a scene by which some result can be differentiated."""


@dataclasses.dataclass(frozen=True, eq=False)
class Derivative:
    """The way back through an operation: products of a cotangent with the Jacobian.

    Attributes:
        routine: kernel of the product. embed: its form where loops are embedded. multipliers: with multipliers.
        by: arguments that have a gradient. values: names of the scene's values that enter the operation.
        state: arguments that the kernel reads. reads: result of the operation that it reads, by this name; "": none.
        keeps: arguments that the operation fills because the way back reads them.
        recomputes: the kernel computes the result that it reads where the caller does not pass it.
        pull: what is launched; None: the kernel alone.
        launch: ``launch(dyn, derivative, out, more, **given)`` launches it where one kernel does not do; None: the
            kernel, by :meth:`.engine.Engine.launch`.
        refuses: ``refuses(dyn, arguments)``, "what came; what is expected" of arguments with which a call has no
            gradient; otherwise "".
        adds: ``adds(dyn)``, arguments by name that a call with a way back has besides those of the caller.
        repeats: ``repeats(call, arguments)`` takes out of the arguments how often the operation runs on its own
            results, and returns it; the results have the names of the arguments that they replace.
        lacking: ``lacking(links)``, "what; way out" where the derivative does not support the scene; otherwise "".
    """

    routine: Routine
    by: tuple[str, ...]
    values: tuple[str, ...] = MOTION_VALUES
    embed: Closed = NO_DERIVATIVE
    multipliers: Closed = NO_DERIVATIVE
    state: tuple[str, ...] = ("q", "qd")
    reads: str = ""
    keeps: tuple[str, ...] = ()
    recomputes: bool = False
    pull: Pull | None = None
    launch: Callable[..., Any] | None = None
    refuses: Callable[[Any, dict[str, Any]], str] = lambda dyn, arguments: ""
    adds: Callable[[Any], dict[str, Any]] = lambda dyn: {}
    repeats: Callable[[str, dict[str, Any]], int] = lambda call, arguments: 1
    lacking: Callable[[Links], str] = lambda links: ""


# -- trials ------------------------------------------------------------------------------------------------------------
@dataclasses.dataclass(frozen=True)
class Trial:
    """Comparison of an operation with the dense float64 reference, in one world.

    Attributes:
        dense: ``dense(reference, *arguments)``, the first result from :class:`warp_spo.reference.dense.Dense`.
        scale: ``scale(reference, expected)``, the error is divided by it; None: the 2-norm of the expected result.
        solves: ``solves(reference, *arguments)``, matrix A and right-hand side b of the equation A x = b that the
            result solves, if it solves one.
        main: ``python -m warp_spo`` and the benchmarks try it; otherwise it is an application.
        call: ``call(dyn, *arguments, out=)`` where arguments do not follow from the declaration.
        reads: names of the random inputs, where they do not follow from the declaration.
    """

    dense: Callable[..., Any]
    scale: Callable[[Any, np.ndarray], float] | None = None
    solves: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None
    main: bool = False
    call: Callable[..., None] | None = None
    reads: tuple[str, ...] = ()


# -- operations --------------------------------------------------------------------------------------------------------
@dataclasses.dataclass(frozen=True, eq=False)
class Operation:
    """A method of :class:`warp_spo.Dynamics`, declared.

    Attributes:
        name: name of the method.
        arguments: arrays and options, in the order of the method. results: what it returns.
        routine: kernel of the open tree; None: the method calls other operations.
        embed: form with ``loops="embed"``. multipliers: form with ``loops="multipliers"``. An operation that declares
            nothing is refused there.
        sharing: form of scenes whose links share dofs: of flexible bodies and rotors.
        touching: ``touching(dyn)`` returns the kernel of a scene with contacts; None: contacts do not matter to it.
        derivative: its way back; None: torch gets no gradients.
        trial: how it is compared with the dense reference.
        product: it is itself a product with a Jacobian, of another operation.
        bundles: arguments that callers pass in objects.
        graphed: what a graph of torch needs of the operation, see :func:`warp_spo.torch.call_in_graph`; None: it
            returns objects that a graph does not know.
    """

    name: str
    arguments: tuple[Argument | Option, ...]
    results: tuple[Result, ...]
    routine: Routine | None = None
    embed: Closed = Refused()
    multipliers: Closed = Refused()
    sharing: Closed = AS_WRITTEN
    touching: Callable[..., Routine] | None = None
    derivative: Derivative | None = None
    trial: Trial | None = None
    product: bool = False
    bundles: tuple[Bundle, ...] = ()
    graphed: tuple[Any, ...] | None = dataclasses.field(default=None, init=False, repr=False)
    _methods: list[Callable[..., Any]] = dataclasses.field(default_factory=list, repr=False)

    def method(self, function: MethodT) -> MethodT:
        """Declare ``function`` to be the method of this operation, which takes all its arguments by name.

        :func:`.call_replay.dispatch` repeats recorded calls, and gives torch the gradients of the operation.
        """
        expected = f"_{self.name}" if self.bundles else self.name
        assert function.__name__ == expected, f"{function.__name__} is declared as {self.name}"
        vars(function)["operation"] = self
        self._methods.append(function)
        returns = str(function.__annotations__.get("return", ""))
        if returns.startswith(("ArrayT", "tuple[ArrayT")):
            written = tuple(one.name for one in self.arrays if one.written)
            keeps = () if self.derivative is None else self.derivative.keeps
            graphed = self.name, tuple(self.parameters), len(self.results), keeps, written
            object.__setattr__(self, "graphed", graphed)

        @functools.wraps(function)
        def call(dyn: Any, *args: Any, **more: Any) -> Any:
            return dispatch(self, dyn, args, more)

        self._methods.append(call)
        return cast(MethodT, call)

    def public(self, function: MethodT) -> MethodT:
        """Declare how users call an operation with bundles: by the signature of ``function``, whose body never runs.

        Bundles are expanded into arguments of the method first, so that recorded calls, torch and JAX see numbers,
        strings and arrays. Of a bundle they see what differs from the defaults.
        """
        vars(function)["operation"] = self
        parameters = list(inspect.signature(function).parameters.values())[1:]
        names = frozenset(one.name for one in parameters)
        most = sum(one.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD for one in parameters)
        bundles, title = tuple((one.name, one.expand) for one in self.bundles), f"Dynamics.{self.name}"
        self.function.__qualname__ = self.name  # in errors of Python

        @functools.wraps(function)
        def call(dyn: Any, *args: Any, **more: Any) -> Any:
            if len(args) > most or not more.keys() <= names:
                self._refuse_call(parameters, args, more)
            for name, expand in bundles:
                if name in more:
                    more.update(expand(title, more.pop(name)))
            return dispatch(self, dyn, args, more)

        self._methods.append(call)
        return cast(MethodT, call)

    def _refuse_call(self, parameters: Sequence[inspect.Parameter], args: tuple, more: dict[str, Any]) -> NoReturn:
        """Raise TypeError for a call that is not written as the signature says."""
        title, names = f"Dynamics.{self.name}", [one.name for one in parameters]
        by_place = [one.name for one in parameters if one.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD]
        by_name = [f"{name}=" for name in names if name not in by_place]
        form = f"dyn.{self.name}({', '.join((*by_place, *by_name))})"
        for name in more:
            for bundle in self.bundles:
                if name in bundle.members:
                    bundle.refuse(title, name)
            if name not in names:
                raise TypeError(f"{title}: {name}= is no argument; expected {form}")
        raise TypeError(f"{title}: {len(args)} arguments by position; expected {len(by_place)} at most, as in {form}")

    def expand(self, call: str, options: dict[str, Any]) -> dict[str, Any]:
        """Return options by name, where bundles of options are replaced by their members.

        Raises:
            TypeError: a member is given by itself.
        """
        return self._replace(call, options, tuple(one for one in self.bundles if not one.written))

    def expand_asked(self, call: str, options: dict[str, Any]) -> dict[str, Any]:
        """Return what ``prepare`` is given, as :meth:`expand`; an array that the call fills is True.

        Raises:
            TypeError: a member is given by itself. ValueError: a bundle has no such member.
        """
        return self._replace(call, options, self.bundles, in_prepare=True)

    def as_given(self, names: Sequence[str]) -> list[str]:
        """Return names of arguments as callers know them: a bundle in place of its members."""
        homes = {name: bundle.name for bundle in self.bundles for name in bundle.members}
        return list(dict.fromkeys(homes.get(name, name) for name in names))

    def _replace(
        self, call: str, options: dict[str, Any], bundles: tuple[Bundle, ...], in_prepare: bool = False
    ) -> dict[str, Any]:
        found = dict(options)
        for bundle in bundles:
            for name in options:
                if name in bundle.members:
                    bundle.refuse(call, name, in_prepare)
            if bundle.name in options:
                found.update((bundle.ask if in_prepare else bundle.expand)(call, found.pop(bundle.name)))
        return found

    def run(self, dyn: Any, *args: Any, **more: Any) -> Any:
        """Return the result without torch's gradients."""
        result, key, arrays = dyn._replays.replay(f"{self.name}, plain", args, more)
        if result is not MISS:
            return result
        settle((*args, *more.values()))
        return dyn._replays.run(key, arrays, lambda: self.function(dyn, *args, **more))

    @property
    def function(self) -> Callable[..., Any]:
        """The method as it is written, without torch's gradients; its first argument is the Dynamics."""
        return self._methods[0]

    @property
    def entry(self) -> Callable[..., Any]:
        """The method with all arguments by name; its first argument is the Dynamics."""
        return self._methods[1]

    @property
    def method_of_users(self) -> Callable[..., Any]:
        """The method as users call it: with bundles, where the operation has some; otherwise :attr:`entry`."""
        return self._methods[-1]

    @functools.cached_property
    def signature(self) -> inspect.Signature:
        """Signature of :attr:`function`."""
        return inspect.signature(self.function)

    @functools.cached_property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """Parameters of :attr:`function` but for the Dynamics, by name."""
        return dict(list(self.signature.parameters.items())[1:])

    def needs(self, name: str) -> bool:
        """Return whether each call passes an argument; ``...`` is the default of one that follows others with some."""
        return self.parameters[name].default in (inspect.Parameter.empty, ...)

    @functools.cached_property
    def arrays(self) -> tuple[Argument, ...]:
        """The arguments that are arrays."""
        return tuple(argument for argument in self.arguments if isinstance(argument, Argument))

    @functools.cached_property
    def options(self) -> tuple[Option, ...]:
        """The arguments that are no arrays."""
        return tuple(argument for argument in self.arguments if isinstance(argument, Option))


def derivative_of(operation: Operation) -> Derivative:
    """Return the derivative of an operation that has one."""
    assert operation.derivative is not None, f"{operation.name} has no derivative"
    return operation.derivative


def find_operations(methods: Mapping[str, Any]) -> dict[str, Operation]:
    """Return the operations among the members of a class by name, in their order."""
    found = [vars(member).get("operation") for member in methods.values() if inspect.isfunction(member)]
    return {operation.name: operation for operation in found if isinstance(operation, Operation)}


STAND_IN = 1e-3  # [s], of steps that only compile
LIMITS: dict[type, tuple[float, float]] = {
    dtype: (float(numbers.tiny), float(numbers.max))
    for dtype, numbers in ((wp.float32, np.finfo(np.float32)), (wp.float64, np.finfo(np.float64)))
}
"""Least and largest normal number of each dtype."""


def seconds(call: Call, dt: Any) -> float:
    """Return ``dt`` [s] as a float.

    Raises:
        TypeError: not a number. ValueError: it requires grad, is not finite, or the dtype does not hold it.
    """
    name = call.name
    if isinstance(dt, float):
        found = float(dt)
    elif dt is ...:
        raise TypeError(f"{name}: dt is missing; expected a number of seconds, the same in all worlds")
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
        found = float(number)
    least, most = LIMITS[call.dtype]
    if found != 0.0 and not least <= abs(found) <= most:
        raise ValueError(f"{name}: dt is {found} s; expected a number that {call.dtype.__name__} holds, finite")
    return found
