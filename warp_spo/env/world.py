"""The symbolic state of one world, which the terms of an environment are functions of: ``World``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import shown
from ..recursions.contact.ground import GroundOffset, height
from ..recursions.step.joint_laws import DEFAULT_BOUND
from ..scene.collision_shapes import floating_bases
from ..trace import spatial
from ..trace.functions import AbstractScalar, clip, where
from ..trace.scalars import floor, lookup
from .compile.fused_kernel import FusedKernel
from .compile.memory_layout import LEFT_OUT, TAKEN, check_memory_name
from .compile.returned import numbers
from .compile.vectors import Vector, as_scalar, as_value, cross, find, rotate, rotate_back, vector
from .curricula import Curriculum, remembered_mean
from .feet import Feet, feet
from .validation import check_number, check_positive

if TYPE_CHECKING:
    from ..trace.functions import Condition
    from .compile.memory_layout import MemoryLayout

ACTIONS = ("action", "action 1", "action 2")  # names under which a world remembers its actions, the newest first
FAR = 1.0  # gap [m] of pairs of bodies that are farther apart, or too far for a step to look for it


class Frame(NamedTuple):
    """A frame of the scene, inertial axes.

    Attributes:
        position: (3,) [m]. quaternion: xyzw (4,). velocity: of its origin (3,) [m/s]. angular_velocity: (3,) [rad/s].
    """

    position: Vector
    quaternion: Vector
    velocity: Vector
    angular_velocity: Vector


class Imu(NamedTuple):
    """Measurements of an inertial measurement unit in a frame, in the frame's axes.

    Attributes:
        acceleration: of its origin less gravity (3,) [m/s^2]. rate: angular velocity (3,) [rad/s].
    """

    acceleration: Vector
    rate: Vector


class World:
    """One world while a term is traced. Its attributes are abstract scalars, or NumPy arrays of them.

    Terms are written with ``+ - * / **``, comparisons, NumPy's sin, cos, exp, log, sqrt, arctan2, abs and the like, and
    :func:`warp_spo.where`, :func:`warp_spo.clip` in place of branches.

    Attributes:
        scene: the scene.
        q, qd: coordinates [coordinate] and velocities [dof]; events assign to their entries.
        action, last_action, action_before: actions of this step, of the step before, and of the one before that.
        contact_force: [point, 3], inertial axes, mean over substeps [N]. contact_gap: [point] distance from the ground
            [m], where the last substep began. contact_slip: [point], speed along the ground [m/s]. Points are those of
            ``scene.contact_points``, and after them ``scene.contact_pairs``, each as one: the force is on the first
            body, the gap at most FAR, 1 m, which it also is where a step finds it infinite because the two are too
            far apart to share a point. In the first observation of an episode gaps and slips are those of its state;
            there is no force, and pairs do not slip.
        time: since the last reset [s].
        dt: of a step of the environment [s].
        values: in events that change values: arrays by name, of abstract scalars or numbers, whose entries they assign.
        fresh: in observations: whether the world has just started anew; None elsewhere.
        before: in resets: the world at the end of the episode; None at the start and in resets on request.
    """

    def __init__(self, layout: MemoryLayout, stage: FusedKernel, fresh: Any = None):
        self._layout, self._stage, self.fresh = layout, stage, fresh
        self.scene = layout.scene
        self.dt = layout.step_dt
        self.kept: dict[str, Vector] = {}
        # Numbers of observations, and by name what those with a history see, the newest first.
        self.measured: dict[Any, Any] = {}
        self.values: dict[str, np.ndarray] = {}
        self.present: dict[str, np.ndarray] = {}  # values of the scene that this stage has changed
        self.lasting = False  # whether what it keeps stays when an episode starts
        self.before: World | None = None
        # Where its episode starts while its memory is that of the one before, and the world before; None: nowhere.
        self.starts: tuple[Condition, World] | None = None
        self.forgets = False  # whether all memory that a reset clears reads as cleared there, or the actions alone

    # -- state -----------------------------------------------------------------------------------------------------
    @functools.cached_property
    def q(self) -> Vector:
        return self.read("q", self.scene.coord_count)

    @functools.cached_property
    def qd(self) -> Vector:
        return self.read("qd", self.scene.dof_count)

    @property
    def default_q(self) -> np.ndarray:
        """The q that resets start from [coordinate], numbers."""
        return self._layout.default_q

    @functools.cached_property
    def steps(self) -> Any:
        """Steps since the start of the episode, in which the state is that came of them."""
        if self.starts is None:
            return self.read("episode_length", 1)[0]
        starts, before = self.starts
        return where(starts, 0.0, before.steps)

    @functools.cached_property
    def time(self) -> Any:
        return self.steps * self.dt

    @property
    def steps_taken(self) -> Any:
        """Steps that the world took in this episode; ``steps`` may be another number, which a caller wrote."""
        return self.sensor(TAKEN, 1, lambda w: w.keep_own(TAKEN, w.memory(TAKEN, 1) + 1.0))[0]

    def whole_steps(self, seconds: float) -> float:
        """Return a time [s] in steps of the environment, a number; whole where it is so but for rounding."""
        return self._layout.whole_steps(check_number("World.whole_steps", "seconds", seconds, 0.0))

    def phase(self, period: float) -> AbstractScalar:
        """Return which part of a period [s] has passed, from 0 to 1; of a whole number of steps it is exact."""
        check_positive("World.phase", "period", period)
        whole = self.whole_steps(period)
        periods = AbstractScalar(floor(as_value(self.steps * (1.0 / whole))))
        return (self.steps - whole * periods) * (1.0 / whole)

    # -- actions and commands --------------------------------------------------------------------------------------
    @property
    def action(self) -> Vector:
        return self.memory("action", self._layout.action_count)

    @property
    def last_action(self) -> Vector:
        return self.memory("action 1", self._layout.action_count)

    @property
    def action_before(self) -> Vector:
        return self.memory("action 2", self._layout.action_count)

    @property
    def weights(self) -> dict[str, Any]:
        """The weights of the rewards by name, numbers and curricula."""
        return self._layout.weights

    def at_level(self, value: Any) -> Any:
        """Return the number that a curriculum gives this world now; what is none is returned as it is."""
        if not isinstance(value, Curriculum):
            return value
        layout, name = self._layout, value.level.name
        remembered = self.memory(name, 1, reset=None)[0]
        layout.levels.setdefault(name, value.level)
        if self._stage.name == "judge" and layout.judged is not None:
            remembered = layout.update_level(name)
        return value.value(value.level.value(remembered))

    def episode_mean(self, call: str, term: str) -> tuple[Any, Any]:
        """Return the mean of a metric, or of a reward before its weight, over the steps of the episode so far.

        The second value is a condition: whether there is one. A metric that was finite in no step has none.

        Args:
            call: that asks, in errors. term: name.
        """
        return remembered_mean(call, self, term)

    @property
    def has_commands(self) -> bool:
        """Whether the environment gives commands."""
        return self._layout.commands is not None

    @property
    def command(self) -> Vector:
        """The commands that the environment gives [command]."""
        if self._layout.commands is None:
            raise ValueError("Env: a term reads commands, and the environment has none; expected Env(commands=...)")
        return self.memory("command", self._layout.commands.size, reset=None)

    # -- contacts --------------------------------------------------------------------------------------------------
    @functools.cached_property
    def contact_force(self) -> np.ndarray:
        count = self._contact_count()
        return self._quiet(self.read("contact_f", 3 * count)).reshape(count, 3)

    @functools.cached_property
    def contact_gap(self) -> Vector:
        gaps, points = self.read("contact_gap", self._contact_count()), len(self.scene.contact_points)
        return vector([*gaps[:points], *(where(gap > FAR, FAR, gap) for gap in gaps[points:])])

    @functools.cached_property
    def contact_slip(self) -> Vector:
        return self.read("contact_slip", self._contact_count())

    def points(self, bodies: Any) -> list[list[int]]:
        """Return, for each body whose label matches, the indices of its contact points; numbers."""
        found = find("Env", "body", self.scene.body_labels, bodies)
        return [[i for i, point in enumerate(self.scene.contact_points) if point.body == body] for body in found]

    def feet(self, bodies: Any, threshold: float = 1.0) -> Feet:
        """Return forces and times of bodies that touch the ground.

        Args:
            bodies: regular expressions of body labels. threshold: force above which a body touches [N].
        """
        return feet(self, bodies, threshold)

    # -- base ------------------------------------------------------------------------------------------------------
    @property
    def base(self) -> int:
        """Index of the free hinge that carries the robot on the inertial frame.

        It is the first one whose tree has further joints; of free bodies without joints, such as objects, the first.
        """
        found = floating_bases(self.scene)
        if found:
            return found[0]
        raise ValueError("Env: a term reads the base, and no hinge of the scene is free on the inertial frame")

    @property
    def base_position(self) -> Vector:
        """Position of the base's origin (3,), inertial axes [m]."""
        start = self.scene.q_start[self.base]
        return self.q[start : start + 3]

    @property
    def base_height(self) -> Any:
        """Height of the base's origin over the ground under it, or over z = 0 in a scene without ground [m]."""
        x, y, z = self.base_position
        return z - self.ground_height(x, y) if self.scene.ground is not None else z

    @property
    def base_quaternion(self) -> Vector:
        """Orientation of the base, xyzw (4,)."""
        start = self.scene.q_start[self.base]
        return self.q[start + 3 : start + 7]

    @property
    def base_angular_velocity(self) -> Vector:
        """Angular velocity in the base's axes (3,) [rad/s]."""
        start = self.scene.qd_start[self.base]
        return rotate_back(self.base_quaternion, self.qd[start + 3 : start + 6])

    @property
    def base_velocity(self) -> Vector:
        """Velocity of the base frame's origin, not of its centre of mass as in ``qd``; base's axes (3,) [m/s]."""
        start = self.scene.qd_start[self.base]
        com = self.value("body_com")[self.scene.hinges[self.base].child]
        return rotate_back(self.base_quaternion, self.qd[start : start + 3]) - cross(self.base_angular_velocity, com)

    @property
    def projected_gravity(self) -> Vector:
        """Unit vector along the world's gravity in the base's axes (3,); without gravity that of -z."""
        gravity, down = self.value("gravity"), np.array([0.0, 0.0, -1.0])
        if gravity.dtype != object:
            size = float(np.linalg.norm(gravity))
            return rotate_back(self.base_quaternion, gravity / size if size > 0.0 else down)
        square = sum(x * x for x in gravity)
        size = np.sqrt(where(square > 0.0, square, 1.0))
        along = [where(square > 0.0, x / size, z) for x, z in zip(gravity, down, strict=True)]
        return rotate_back(self.base_quaternion, along)

    @property
    def heading(self) -> Any:
        """Angle of the base about the vertical [rad]."""
        forward = rotate(self.base_quaternion, np.array([1.0, 0.0, 0.0]))
        return np.arctan2(forward[1], forward[0])

    # -- joints ----------------------------------------------------------------------------------------------------
    def joints(self, names: Any = None) -> list[int]:
        """Return the indices of the hinges of one coordinate whose labels match; None: all of them. Numbers."""
        single = [i for i, hinge in enumerate(self.scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
        if names is None:
            return single
        labels = [self.scene.joint_labels[i] for i in single]
        return [single[i] for i in find("Env", "joint of one coordinate", labels, names)]

    def joint_q(self, names: Any = None) -> Vector:
        """Return the coordinates of :meth:`joints`."""
        return self.q[[int(self.scene.q_start[i]) for i in self.joints(names)]]

    def joint_default(self, names: Any = None) -> np.ndarray:
        """Return the default coordinates of :meth:`joints`, numbers."""
        return self.default_q[[int(self.scene.q_start[i]) for i in self.joints(names)]]

    def encoder_q(self, names: Any = None) -> Vector:
        """Return the coordinates of :meth:`joints` as their encoders read them, see :func:`events.encoder_bias`."""
        return self.joint_q(names) + self.encoder_bias(self.joints(names))

    def encoder_bias(self, hinges: Sequence[int]) -> Vector:
        """Return what the encoders of hinges read beyond the truth; zeros without :func:`events.encoder_bias`."""
        biased = self._layout.biased
        bias: Any = self.memory("encoder bias", len(biased), reset=None) if biased else []
        return vector(bias[biased.index(hinge)] if hinge in biased else 0.0 for hinge in hinges)

    def joint_qd(self, names: Any = None) -> Vector:
        """Return the velocities of :meth:`joints`."""
        return self.qd[[int(self.scene.qd_start[i]) for i in self.joints(names)]]

    @property
    def joint_force(self) -> Vector:
        """Force of actuators, drives and efforts, as actions command, in the state after the step [dof] [N m or N].

        In the first observation of an episode it is that of the action 0 in its state.

        Raises:
            ValueError: a drive and an actuator of a joint share its effort limit: how much each gives is not known.
        """
        arrays, count = self._layout.action_arrays, self.scene.dof_count
        total = vector(0.0 for _ in range(count))
        acted: set[int] = set()
        if "ctrl" in arrays:
            total = total + self.read("actuator_force", count)
            acted = {int(self.scene.qd_start[hinge]) for each in self.scene.actuators for hinge in each.hinges}
        if "tau" in arrays:
            total = total + self.read("tau", count)
        if "target_q" in arrays:
            ke, kd, most = (self.value(f"joint_{name}") for name in ("target_ke", "target_kd", "effort_limit"))
            target = self.read("target_q", self.scene.coord_count)
            for hinge in self.joints():
                i, j = int(self.scene.q_start[hinge]), int(self.scene.qd_start[hinge])
                limit = as_scalar(most[j])
                force = as_scalar(ke[j]) * (target[i] - self.q[i]) - as_scalar(kd[j]) * self.qd[j]
                unlimited = not isinstance(most[j], AbstractScalar) and most[j] >= DEFAULT_BOUND
                without_drive = not isinstance(ke[j], AbstractScalar) and ke[j] == 0.0
                if j in acted and not unlimited and not without_drive:
                    label = shown(self.scene.joint_labels[hinge])
                    raise ValueError(
                        f"World.joint_force: joint {label!r} has a drive and an actuator that share its effort limit; "
                        "expected one of them; set its joint_target_ke to zero, or joint_effort_limit=1e6"
                    )
                total[j] = total[j] + clip(force, -limit, limit)
        return total

    # -- ground ----------------------------------------------------------------------------------------------------
    def ground_height(self, x: Any, y: Any) -> Any:
        """Return the height of the scene's ground at a point (x, y) [m] of the horizontal plane, inertial axes [m]."""
        if self.scene.ground is None:
            raise ValueError("World.ground_height: the scene has no ground; expected scene.with_contacts(..., ground)")
        origin, field = self.value("ground_origin"), self.value("ground_field")
        moved = [as_value(each) for each in origin] if len(origin) else [0.0] * 3
        place = GroundOffset(spatial.Vector(moved), as_value(field[0]) if len(field) else 0.0)
        stage, ground = self._stage, self.scene.ground
        return AbstractScalar(
            height(stage.graph, ground, as_value(x), as_value(y), place, by_cell_table=not stage.rows)
        )

    def table(self, name: str, numbers: np.ndarray) -> Callable[[Any], Vector]:
        """Return a function from a row, a whole number, to that row of a table of numbers [row, n].

        Args:
            name: of the table. numbers: the same in all worlds.
        """
        held = self._layout.table(name, numbers)
        width, graph = numbers.shape[1], self._stage.graph
        return lambda row: vector(map(AbstractScalar, lookup(graph, held, as_value(row), width)))

    # -- frames, values --------------------------------------------------------------------------------------------
    def frame(self, name: Any) -> Frame:
        """Return a frame: the name of a site or of a body, a body, or (body, pose in the body)."""
        at = self._layout.frame(name)
        pose = vector(self._scalar("frame_pose", 7 * at + i) for i in range(7))
        rates = vector(self._scalar("frame_velocity", 6 * at + i) for i in range(6))
        return Frame(pose[:3], pose[3:], rates[:3], rates[3:])

    def jacobian(self, name: Any) -> np.ndarray:
        """Return the velocity of a frame's origin, then its angular velocity, per unit qd [6, dof], inertial axes.

        ``name`` as :meth:`frame`.
        """
        at, dofs = self._layout.jacobian(name), self.scene.dof_count
        entries = (self._scalar("frame_jacobian", 6 * dofs * at + i) for i in range(6 * dofs))
        return vector(entries).reshape(6, dofs)

    def imu(self, name: Any) -> Imu:
        """Return what an inertial measurement unit at a frame measures; ``name`` as :meth:`frame`.

        The acceleration is that of the last step of the dynamics. In the first observation of an episode it is that of
        a step from its state with the action 0, which nothing else sees.
        """
        frame, at = self.frame(name), self._layout.frame(name)
        acceleration = vector(self._scalar("frame_acceleration", 6 * at + i) for i in range(3))
        felt = acceleration - vector(as_scalar(x) for x in self.value("gravity"))
        turned = (rotate_back(frame.quaternion, v) for v in (felt, frame.angular_velocity))
        return Imu(*turned)

    def value(self, name: str) -> np.ndarray:
        """Return a value of the scene, such as "body_com" [body, 3]: of this world where it is randomised."""
        if name in self.values or name in self.present:
            return self.values[name] if name in self.values else self.present[name]
        if name not in self.scene.values:
            raise ValueError(f"World.value: unknown value {name!r}; expected one of {', '.join(self.scene.values)}")
        shape = self.scene.values[name].shape[1:]
        if name not in self._layout.values:
            if self.scene.values[name].shape[0] == 1:
                return self.scene.values[name][0]
            self._layout.unequal.add(name)
        return self.read(f"value_{name}", int(np.prod(shape))).reshape(shape)

    def user(self, term: Any) -> Any:
        """Return the numbers of a user's term in torch."""
        stage = self._stage.name
        start = self._layout.user(term, "observe" if stage == "final" else stage)
        values = vector(self._scalar("user", start + i) for i in range(term.size))
        return values[0] if term.size == 1 else values

    # -- random numbers --------------------------------------------------------------------------------------------
    def uniform(self, low: Any = 0.0, high: Any = 1.0) -> Any:
        """Return a new random number between ``low`` and ``high``, which may be curricula."""
        low, high = self.at_level(low), self.at_level(high)
        return low + (high - low) * AbstractScalar(self._stage.draw())

    def normal(self, deviation: Any = 1.0) -> Any:
        """Return a new normal random number of mean zero."""
        radius = np.sqrt(-2.0 * np.log(1.0 - self.uniform()))  # Box and Muller
        return deviation * radius * np.cos(2.0 * np.pi * self.uniform())

    def integer(self, low: int, high: int) -> Any:
        """Return a new random whole number from ``low`` to ``high``, both included."""
        return low + AbstractScalar(floor((high - low + 1.0) * self._stage.draw()))

    # -- memory ----------------------------------------------------------------------------------------------------
    def memory(self, name: str, size: int, reset: Any = LEFT_OUT) -> Vector:
        """Return numbers that this world keeps from step to step [size]; :meth:`keep` changes them.

        Args:
            name: of the numbers, the same in all terms that share them.
            size: how many.
            reset: their value at the start of an episode; None: a reset leaves them alone, and they start from zero.
                Left out: what another term says; None if :class:`events.Start` or :class:`events.Reset` keeps them; 0.
        """
        self._layout.remember(name, size, reset)
        found = self.kept[name] if name in self.kept else self.stored_memory(name)
        cleared = self._layout.memory[name][2]
        if self.starts is None or cleared is None or not (self.forgets or name in ACTIONS):
            return found
        return vector(where(self.starts[0], cleared, x) for x in found)

    def stored_memory(self, name: str) -> Vector:
        """Return numbers of :meth:`memory` as they were before this stage."""
        start, size, _ = self._layout.memory[name]
        return vector(self._scalar("memory", start + i) for i in range(size))

    def keep(self, name: str, values: Any) -> None:
        """Set numbers of :meth:`memory`; a reset sets those without a :meth:`memory` call to zero.

        What :class:`events.Start` and :class:`events.Reset` keep stays. Numbers that no reset changes stay as they were
        where new ones are not finite. A term that is a reward and an observation,
        too, keeps twice in a step; :meth:`sensor` does so once.

        Raises:
            ValueError: the environment itself remembers something under this name, such as "action".
        """
        check_memory_name("World.keep", name)
        self.keep_own(name, values)

    def keep_own(self, name: str, values: Any) -> None:
        """Set numbers of :meth:`memory` under any name, as the environment itself does."""
        size = self._layout.memory[name][1] if name in self._layout.memory else None
        self.kept[name] = numbers(f"World.keep({name!r}) was given", values, size)
        self._layout.remember(name, len(self.kept[name]), None if self.lasting else LEFT_OUT)

    def sensor(self, name: str, size: int, update: Callable[[World], None], reset: float | None = 0.0) -> Vector:
        """Return numbers of :meth:`memory` that ``update`` keeps once in each step, after the dynamics.

        Args:
            name, size, reset: as :meth:`memory`.
            update: function of a ``World`` that calls :meth:`keep` with this name.
        """
        self._layout.sensors[name] = size, reset, update
        self._layout.remember(name, size, reset)
        if self._stage.name in ("judge", "final") and name not in self.kept:
            update(self)
        return self.memory(name, size, reset)

    def number(self, observation: Any) -> int:
        """Return the number of an observation that remembers something, the same in all stages."""
        numbers = self._layout.observations
        return numbers.setdefault(observation, len(numbers))

    def drawn(self, name: str, size: int, draw: Callable[[World], Any]) -> Vector:
        """Return numbers of :meth:`memory` that are drawn once, when the environment is made, and then stay.

        Args:
            name, size: as :meth:`memory`.
            draw: function of a ``World`` that returns the numbers. Terms with one name share the numbers, and the first
                one's function draws them: a term is traced several times, with a new function each time.
        """
        self._layout.drawn.setdefault(name, draw)
        return self.memory(name, size, reset=None)

    # -- inside ----------------------------------------------------------------------------------------------------
    def read(self, array: str, size: int) -> Vector:
        """Return the entries of an array of the environment."""
        return vector(self._scalar(array, i) for i in range(size))

    def _scalar(self, array: str, entry: int) -> AbstractScalar:
        return AbstractScalar(self._stage.graph.input(array, entry))

    def _quiet(self, values: Vector) -> Vector:
        """Return values of the last step, zero in a world that was reset since."""
        if self.fresh is None:
            return values
        return vector(where(self.fresh, 0.0, value) for value in values)

    def _contact_count(self) -> int:
        count = self.scene.contact_count
        if not count:
            raise ValueError("Env: a term reads contacts, and the scene has none; expected scene.with_contacts(...)")
        return count
