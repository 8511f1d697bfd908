"""Events: what changes a world's state at the start of an episode, or from time to time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..errors import as_names
from ..scene.terrain import Tiles
from ..trace.functions import where
from .actions import actuator_labels
from .compile.vectors import between, find, multiply, vector
from .curricula import Curriculum, ends_of
from .drawn_values import WHOLE, as_rows, check_draws
from .validation import Range, check_function, check_interval, check_number, check_span, check_steps
from .world import World


@dataclasses.dataclass(frozen=True, eq=False)
class Reset:
    """A function that changes ``w.q``, ``w.qd`` of a world whose episode starts; they are default_q and zero before.

    Args:
        change: function of a ``World``, which assigns to entries of ``w.q`` and ``w.qd``. ``w.before`` is the
            world at the end of the episode, at rest in default_q if its state was out of bounds. Values that it keeps
            with ``w.keep`` stay until the next reset.
        first: None, or a function that keeps what worlds remember for good, when the environment is made.
        levels: names of what worlds remember that say how far they have come; a training that resumes goes on there.
    """

    change: Callable[[World], None]
    first: Callable[[World], None] | None = None
    levels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_function("events.Reset", "change", self.change)
        if self.first is not None:
            check_function("events.Reset", "first", self.first)
        object.__setattr__(self, "levels", as_names("events.Reset", "levels", self.levels, ("terrain",)))


@dataclasses.dataclass(frozen=True, eq=False)
class Interval:
    """A function that changes ``w.q``, ``w.qd`` of a world from time to time.

    Args:
        change: function of a ``World``.
        seconds: range of the time from one change to the next, rounded up to whole steps.
    """

    change: Callable[[World], None]
    seconds: Range = (1.0, 3.0)

    def __post_init__(self) -> None:
        check_function("events.Interval", "change", self.change)
        check_interval("events.Interval", self.seconds)


@dataclasses.dataclass(frozen=True, eq=False)
class Values:
    """A function that changes values of the scene in a world, such as masses and friction; nothing is compiled anew.

    Args:
        names: of the values that it changes, of those that ``Dynamics`` takes as ``variable``.
        change: function of a ``World`` that assigns to entries of ``w.values[name]``, which are the scene's own
            numbers before; arrays [...] in Newton's layout.
        when: "start": once, when the environment is made, and in ``env.reset(seed=)``. "reset": at each start of an
            episode. Or the range of the time from one change to the next, and from the start to the first one [s], in
            whole steps, rounded up.
    """

    names: tuple[str, ...]
    change: Callable[[World], None]
    when: str | Range = "start"

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", as_names("events.Values", "names", self.names, ("body_mass",)))
        check_function("events.Values", "change", self.change)
        if isinstance(self.when, str) and self.when not in ("start", "reset"):
            raise ValueError(f"events.Values: when is {self.when!r}; expected 'start', 'reset' or a range of seconds")
        if not isinstance(self.when, str):
            check_interval("events.Values: when", self.when)


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """A function that keeps what a world remembers for good, with ``w.keep``, when the environment is made.

    Args:
        change: function of a ``World``.
    """

    change: Callable[[World], None]

    def __post_init__(self) -> None:
        check_function("events.Start", "change", self.change)


@dataclasses.dataclass(frozen=True, eq=False)
class EncoderBias(Start):
    """See :func:`encoder_bias`."""

    names: Any = None


def joints(position: Range = (0.0, 0.0), velocity: Range = (0.0, 0.0), names: Any = None) -> Reset:
    """Return a reset that adds uniform numbers to joints' coordinates and velocities.

    Args:
        position: [rad or m]. velocity: [rad/s or m/s]. names: regular expressions of joints; None: all.
    """
    position = check_span("events.joints", "position", position)
    velocity = check_span("events.joints", "velocity", velocity)

    def change(w: World) -> None:
        for hinge in w.joints(names):
            if position != (0.0, 0.0):
                w.q[w.scene.q_start[hinge]] += w.uniform(*position)
            if velocity != (0.0, 0.0):
                w.qd[w.scene.qd_start[hinge]] += w.uniform(*velocity)

    return Reset(change)


def base(
    x: Range = (0.0, 0.0),
    y: Range = (0.0, 0.0),
    z: Range = (0.0, 0.0),
    yaw: Range = (0.0, 0.0),
    roll: Range = (0.0, 0.0),
    pitch: Range = (0.0, 0.0),
    velocity: Range = (0.0, 0.0),
    angular_velocity: Range = (0.0, 0.0),
) -> Reset:
    """Return a reset that moves and turns the base by uniform numbers, and gives it a velocity.

    Args:
        x, y, z: [m], inertial axes. yaw, roll, pitch: [rad]. velocity: of each axis [m/s]. angular_velocity: of each
            axis [rad/s].
    """
    given = {"x": x, "y": y, "z": z, "yaw": yaw, "roll": roll, "pitch": pitch}
    for name, each in (given | {"velocity": velocity, "angular_velocity": angular_velocity}).items():
        check_span("events.base", name, each)

    def change(w: World) -> None:
        start, rate = int(w.scene.q_start[w.base]), int(w.scene.qd_start[w.base])
        for i, places in enumerate((x, y, z)):
            if tuple(places) != (0.0, 0.0):
                w.q[start + i] += w.uniform(*places)
        quaternion = w.q[start + 3 : start + 7]
        for axis, angles in ((0, roll), (1, pitch), (2, yaw)):
            if tuple(angles) != (0.0, 0.0):
                half = 0.5 * w.uniform(*angles)
                turn = [0.0, 0.0, 0.0, np.cos(half)]
                turn[axis] = np.sin(half)
                quaternion = multiply(turn, quaternion)
        w.q[start + 3 : start + 7] = quaternion
        for first, rates in ((rate, velocity), (rate + 3, angular_velocity)):
            if tuple(rates) != (0.0, 0.0):
                for i in range(3):
                    w.qd[first + i] += w.uniform(*rates)

    return Reset(change)


def terrain(tiles: Tiles, rows: int | None = None, level: bool = True) -> Reset:
    """Return a reset that moves the base to the middle of a tile; the row, the difficulty, follows success.

    Worlds keep the column that they draw at first. A world that walked more than half the length of a tile in its
    episode goes up a row; one that walked less than half of what its last command asked for goes down one. After the
    last row the row is drawn anew. ``env.memory("terrain")`` [world, 2] has rows and columns.

    Args:
        tiles: from ``spo.terrain.tiles``, the scene's ground. rows: rows to start in; None: half of them.
        level: whether rows change; otherwise they are drawn at each reset.
    """
    count, columns = tiles.origins.shape[:2]
    first_rows = max(1, count // 2) if rows is None else rows
    if not 1 <= first_rows <= count:
        raise ValueError(f"events.terrain: rows is {rows!r}; expected 1 to {count}, the rows of the tiles")
    field = tiles.field
    length = field.cells[0] * (field.heights.shape[0] - 1) / count

    def first(w: World) -> None:
        w.keep("terrain", [w.integer(0, first_rows - 1), w.integer(0, columns - 1)])

    def change(w: World) -> None:
        row, column = map(between, w.memory("terrain", 2, reset=None), (count - 1.0, columns - 1.0))
        origins = w.table("terrain", tiles.origins.reshape(-1, 3))
        if not level:
            row = w.integer(0, first_rows - 1)
        elif w.before is not None:
            old = w.before
            way = old.base_position[:2] - origins(row * float(columns) + column)[:2]
            walked = np.hypot(way[0], way[1])
            up = walked > 0.5 * length
            down = ~up
            if old.has_commands:
                down = down & (walked < 0.5 * np.hypot(old.command[0], old.command[1]) * old.steps_taken * old.dt)
            row = row + where(up, 1.0, 0.0) - where(down, 1.0, 0.0)
            row = where(row > count - 0.5, w.integer(0, count - 1), where(row < 0.0, 0.0, row))
        w.keep("terrain", [row, column])
        start = int(w.scene.q_start[w.base])
        for i, x in enumerate(origins(row * float(columns) + column)):
            w.q[start + i] = w.q[start + i] + x

    return Reset(change, first, ("terrain",))


def push(
    velocity: float | Curriculum = 0.5,
    vertical: float | Curriculum = 0.0,
    angular_velocity: float | Curriculum = 0.0,
    seconds: Range = (1.0, 3.0),
) -> Interval:
    """Return pushes: the base's velocity changes by uniform numbers.

    Args:
        velocity: largest change along x and along y [m/s]. vertical: along z [m/s]. angular_velocity: about each axis
            [rad/s]. They may be curricula. seconds: range of the time between pushes.
    """
    for name, most in (("velocity", velocity), ("vertical", vertical), ("angular_velocity", angular_velocity)):
        for end in ends_of(most):
            check_number("events.push", name, end, 0.0)

    def change(w: World) -> None:
        rate = int(w.scene.qd_start[w.base])
        for i, most in enumerate((velocity, velocity, vertical, *3 * (angular_velocity,))):
            if most != 0.0:
                w.qd[rate + i] += w.uniform(-most, most)

    return Interval(change, seconds)


def randomise(
    name: str,
    span: Range | Sequence[Range],
    how: str = "scale",
    names: Any = None,
    when: str | Range = "start",
    alike: bool = False,
) -> Values:
    """Return an event that draws a value of the scene anew: the scene's own number times, plus, or replaced by a draw.

    Args:
        name: of the value, such as "body_mass", "contact_friction", "joint_armature", "actuator_gain", "gravity".
        span: (lowest, highest) of the uniform draw; one pair for each number along the value's last axis, if it has
            one, such as three of "body_com" [m]. A curriculum of such a pair changes it.
        how: "scale", "add" or "set".
        names: regular expressions of bodies for values of bodies and contacts (those of their points, and of the pairs
            that they are in), of joints for values of joints, of actuators for values of actuators; None: all.
        when: see :class:`Values`.
        alike: all entries get the same draw.

    Raises:
        ValueError: an argument is invalid; or, when the environment is made, a draw may be what the value cannot be,
            such as a mass of zero.
    """
    if how not in ("scale", "add", "set"):
        raise ValueError(f"events.randomise: how is {how!r}; expected 'scale', 'add' or 'set'")
    mixed = isinstance(span, list | tuple) and any(isinstance(each, Curriculum) for each in span)
    several = mixed or (not isinstance(span, Curriculum) and np.ndim(span) == 2)
    spans: list[Any] = list(span) if several else [span]  # type: ignore[arg-type]
    for each in spans:
        check_span("events.randomise", f"span of {name}", each)
    if when == "start" and any(isinstance(each, Curriculum) for each in spans):
        raise ValueError(
            f"events.randomise: span of {name} is a curriculum and when is 'start', before its first step; expected "
            "when='reset' or a range of seconds"
        )
    if not isinstance(alike, bool):
        raise ValueError(f"events.randomise: alike is {alike!r}; expected True or False")
    combine = {"scale": lambda x, d: x * d, "add": lambda x, d: x + d, "set": lambda x, d: d}[how]

    def change(w: World) -> None:
        array = w.values[name]
        rows = as_rows(name, array)
        if len(spans) not in (1, rows.shape[1]):
            raise ValueError(f"events.randomise: {name} has {rows.shape[1]} numbers an entry; span has {len(spans)}")
        entries = entries_of(w.scene, name, names)
        check_draws(w.scene, name, entries, spans, how, w._layout.values)
        draws: list[Any] = []
        for i, entry in enumerate(entries):
            if i == 0 or not alike:
                draws = [w.uniform(*each) for each in spans]
            for j in range(rows.shape[1]):
                rows[entry, j] = combine(rows[entry, j], draws[j if len(draws) > 1 else 0])
        w.values[name] = rows.reshape(array.shape)

    return Values((name,), change, when)


def pseudo_inertia(
    names: Any = None,
    size: float = 0.1,
    stretch: float = 0.1,
    shear: float = 0.0,
    shift: float = 0.0,
    when: Any = "start",
) -> Values:
    """Return an event that draws mass, centre of mass and inertia anew, as some body of positive density has them.

    The 4 x 4 pseudo-inertia J of a body becomes T J T^T with T = exp(a) [[diag(exp(d)) + s, t], [0, 1]] and a strictly
    upper triangular s: the body's matter is scaled by exp(2 a), stretched, sheared and shifted (Rucker and Wensing
    2022, "Smooth parameterization of rigid-body inertia").

    Args:
        names: regular expressions of bodies; None: all that have mass.
        size: largest a. stretch: largest d. shear: largest entry of s. shift: largest entry of t [m].
        when: see :class:`Values`.
    """
    for name, most in (("size", size), ("stretch", stretch), ("shear", shear), ("shift", shift)):
        check_number("events.pseudo_inertia", name, most, 0.0)
    changed = ("body_mass", "body_com", "body_inertia")

    def change(w: World) -> None:
        mass, com, inertia = (w.values[name] for name in changed)
        for body in entries_of(w.scene, "body_mass", names):
            m = float(w.scene.values["body_mass"][0][body])
            if m <= 0.0:
                continue
            c, about = w.scene.values["body_com"][0][body], w.scene.values["body_inertia"][0][body]
            spread = 0.5 * np.trace(about) * np.eye(3) - about + m * np.outer(c, c)
            J = np.block([[spread, m * c[:, None]], [m * c[None], np.array([[m]])]])
            T = np.zeros((4, 4), dtype=object)
            for i in range(3):
                T[i, i] = np.exp(w.uniform(-stretch, stretch)) if stretch else 1.0
                T[i, 3] = w.uniform(-shift, shift) if shift else 0.0
                for j in range(i + 1, 3):
                    T[i, j] = w.uniform(-shear, shear) if shear else 0.0
            T[3, 3] = 1.0
            new = T @ J @ T.T * (np.exp(2.0 * w.uniform(-size, size)) if size else 1.0)
            mass[body] = new[3, 3]
            com[body] = vector(new[i, 3] / new[3, 3] for i in range(3))
            central = new[:3, :3] - new[3, 3] * np.outer(com[body], com[body])
            inertia[body] = (central[0, 0] + central[1, 1] + central[2, 2]) * np.eye(3) - central

    return Values(changed, change, when)


def servo_gains(
    stiffness: Range = (0.8, 1.2), damping: Range = (0.8, 1.2), names: Any = None, when: str | Range = "start"
) -> Values:
    """Return an event that scales the gains of position servos: kp, which is a gain and a bias, and kv.

    Args:
        stiffness: of the factor of kp. damping: of that of kv. names: regular expressions of actuators; None: all.
        when: see :class:`Values`.
    """
    for name, factors in (("stiffness", stiffness), ("damping", damping)):
        check_span("events.servo_gains", name, factors, 0.0)

    def change(w: World) -> None:
        gain, bias = w.values["actuator_gain"], w.values["actuator_bias"]
        for entry in entries_of(w.scene, "actuator_gain", names):
            kp = w.uniform(*stiffness)
            gain[entry], bias[entry, 1] = gain[entry] * kp, bias[entry, 1] * kp
            bias[entry, 2] = bias[entry, 2] * w.uniform(*damping)

    return Values(("actuator_gain", "actuator_bias"), change, when)


def delays(steps: tuple[int, int], when: str | Range = "start", names: Any = None, alike: bool = True) -> Values:
    """Return an event that draws the delay of actuators anew, in steps of the dynamics, both ends included."""
    check_steps("events.delays", "steps", steps)

    def change(w: World) -> None:
        for i, entry in enumerate(entries_of(w.scene, "actuator_delay", names)):
            if i == 0 or not alike:
                drawn = w.integer(*steps)
            w.values["actuator_delay"][entry] = drawn

    return Delays(("actuator_delay",), change, when, int(steps[1]))


@dataclasses.dataclass(frozen=True, eq=False)
class Delays(Values):
    """See :func:`delays`."""

    longest: int = 0


def encoder_bias(size: float = 0.015, names: Any = None) -> EncoderBias:
    """Return an event that draws once what joints' encoders read beyond the truth, up to ``size`` [rad or m]."""
    check_number("events.encoder_bias", "size", size, 0.0)

    def change(w: World) -> None:
        w.keep("encoder bias", [w.uniform(-size, size) for _ in w.joints(names)])

    return EncoderBias(change, names)


def entries_of(scene: Any, name: str, names: Any) -> list[int]:
    """Return the entries of a value that regular expressions name; None: all."""
    if name in WHOLE:
        return [0]
    family = name.split("_")[0]
    if family == "contact":
        pairs = [{pair.body, pair.other} for pair in scene.contact_pairs]
        members = [{point.body} for point in scene.contact_points] + pairs
        if names is None:
            return list(range(len(members)))
        bodies = set(find("events.randomise", "body", scene.body_labels, names))
        entries = [i for i, own in enumerate(members) if own & bodies]
        if not entries:
            raise ValueError(f"events.randomise: no contact is of a body {names!r}; expected bodies with contacts")
        return entries
    if family == "joint":
        start, count = (
            (scene.q_start, scene.coord_count) if name == "joint_rest_q" else (scene.qd_start, scene.dof_count)
        )
        if name in ("joint_X_p", "joint_X_c"):
            start, count = np.arange(len(scene.hinges) + 1), len(scene.hinges)
        if names is None:
            return list(range(count))
        hinges = find("events.randomise", "joint", scene.joint_labels, names)
        return [i for hinge in hinges for i in range(int(start[hinge]), int(start[hinge + 1]))]
    labels = scene.body_labels if family == "body" else actuator_labels(scene)
    entries = list(range(len(labels))) if names is None else find("events.randomise", family, labels, names)
    if name == "actuator_gear":  # of each hinge of each actuator
        starts = np.cumsum([0, *(len(each.hinges) for each in scene.actuators)])
        return [i for entry in entries for i in range(starts[entry], starts[entry + 1])]
    return entries


def changed_values(scene: Any, events: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of the values that events change; ValueError if one is none of a scene's."""
    events = [event for event in events if isinstance(event, Values)]
    names = dict.fromkeys(name for event in events for name in event.names)
    for name in names:
        if name == "actuator_delay" and not all(isinstance(event, Delays) for event in events if name in event.names):
            raise ValueError(
                "Env: an event changes actuator_delay and does not say how long delays may be; expected events.delays"
            )
        if name not in scene.values:
            raise ValueError(f"Env: an event changes {name!r}; expected one of {', '.join(scene.values)}")
        if not scene.values[name][0].size:
            raise ValueError(f"Env: an event changes {name}, of which the scene has none; leave the event out")
        if scene.values[name].shape[0] > 1:
            raise ValueError(f"Env: an event changes {name}, which differs between worlds of the scene already")
    return tuple(names)
