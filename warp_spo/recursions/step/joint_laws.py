"""Forces of the hinges in a time step: springs, dampers, drives, actuators, limits and friction, all implicit.

A step of h seconds takes qd to qd' = qd + u and moves q along h qd'. The force of every law of a dof is a linear
function of u between two bounds,

    f(u) = force - resistance u, held between ``least`` and ``most``,

that does not increase with u. Each of its three pieces is linear, so that an armature h resistance and a force make it
implicit: (Mass + h R) qdd = tau - bias_force + F, u = h qdd. The active piece is guessed and checked afterwards, a
semismooth Newton iteration that is exact once the guess is right.

A hinge's effort limit bounds what its motor gives, the sum of its drive and its actuators.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...errors import UnsupportedError
from ...scene.parts import UNLIMITED
from ...scene.scene import Scene
from ...trace.scalars import Value, absolute, is_constant, less, reciprocal, select
from ...trace.spatial import total
from ..model.effective_mass import masses
from ..model.links import Link, Links
from ..model.scene_cache import cached_by_scene

CREEP = 1e-4  # rate [rad/s, m/s] below which dry friction is a damper; it saturates at this rate
DEFAULT_BOUND = 1e6  # effort and velocity limits of this size and more are no limits; Newton's default
HOLD = 300.0  # resistance of a velocity limit, in inertias / h; the excess over the limit shrinks by this factor
FREE = 1e20  # bound that no force or rate reaches, in place of a variable one of DEFAULT_BOUND and more
LIMIT, FRICTION = "limit", "friction"  # roles of laws
LEAST_SCALE = 1e-8  # strength times gear below which a force is nothing; its inverse square is in range of float32
NOISE = 4.0  # roundings of a law's terms; two pieces may differ by so much where they meet


class Law(NamedTuple):
    """f(u) = scale * clip(force - resistance u, least, most); None is no bound.

    ``scale`` is zero or more and does not influence which piece is active, so that derivatives by it exist at zero. A
    law without bounds has scale 1: its force and resistance contain the factor already.

    ``role`` is LIMIT or FRICTION where a step with contacts treats a law in its own way; ``depth`` is how far outside a
    limit q is, and ``stiffness`` its spring. ``symmetric``: the bounds are opposite numbers.
    """

    force: Value
    resistance: Value
    least: Value | None = None
    most: Value | None = None
    scale: Value = 1.0
    role: str = ""
    depth: Value = 0.0
    stiffness: Value = 0.0
    symmetric: bool = False

    @property
    def has_bounds(self) -> bool:
        return self.least is not None or self.most is not None

    def line(self, u: Value) -> Value:
        return self.force - self.resistance * u

    def clip(self, line: Value) -> Value:
        if self.most is not None:
            line = select(less(self.most, line), self.most, line)
        if self.least is not None:
            line = select(less(line, self.least), self.least, line)
        return line

    def at(self, u: Value) -> Value:
        """Return f(u)."""
        return self.scale * self.clip(self.line(u))

    def piece(self, u: Value) -> Law:
        """Return the piece that is active at ``u``, as a law without bounds."""
        if not self.has_bounds:
            return self
        line = self.line(u)
        force, resistance = self.force, self.resistance
        if self.most is not None:
            over = less(self.most, line)
            force, resistance = select(over, self.most, force), select(over, 0.0, resistance)
        if self.least is not None:
            under = less(line, self.least)
            force, resistance = select(under, self.least, force), select(under, 0.0, resistance)
        return Law(self.scale * force, self.scale * resistance)

    def is_mispredicted(self, guess: Value, u: Value, epsilon: float) -> Value:
        """Return non-zero where the piece at ``guess`` differs from the law at ``u`` by more than rounding."""
        if not self.has_bounds:
            return 0.0
        one = self._replace(scale=1.0)
        piece = one.piece(guess)
        size = absolute(piece.force) + absolute(piece.resistance * u)
        return less(NOISE * epsilon * size, absolute(one.at(u) - piece.line(u)))

    def active_resistance(self, u: Value, epsilon: float) -> Value:
        """Return -df/du at ``u``: scale * resistance between the bounds, and zero where a bound cuts the force.

        If the force at ``u`` differs from a bound by no more than rounding, it counts as between the bounds. A dof
        without mass is solved from its laws alone, so that its force may lie on a bound up to rounding.
        """
        if not self.has_bounds:
            return self.resistance
        line, size = self.line(u), absolute(self.force) + absolute(self.resistance * u)
        cut = less(NOISE * epsilon * size, absolute(self.clip(line) - line))
        return select(cut, 0.0, self.scale * self.resistance)

    def crosses_bounds(self, guess: Value, u: Value) -> Value:
        """Return non-zero where ``guess`` and ``u`` lie beyond opposite bounds."""
        if self.least is None or self.most is None:
            return 0.0
        before, after = self.line(guess), self.line(u)
        down = less(self.most, before) * less(after, self.least)
        up = less(before, self.least) * less(self.most, after)
        return down + up

    @property
    def root(self) -> Value:
        """The u at which the force is zero."""
        return self.force * reciprocal(self.resistance)


def add_laws(laws: list[Law]) -> Law:
    """Return the sum of laws without bounds."""
    return Law(total(law.force for law in laws), total(law.resistance for law in laws))


def clip(x: Value, low: Value | None, high: Value | None) -> Value:
    """Return ``x`` between two bounds; None is no bound."""
    if high is not None:
        x = select(less(high, x), high, x)
    if low is not None:
        x = select(less(x, low), low, x)
    return x


def limit_sum(laws: list[Law], bound: Value) -> list[Law]:
    """Return laws whose sum is that of ``laws``, held between -``bound`` and ``bound``.

    Exact where no law has bounds of its own, or one has and the others have no resistance. Otherwise the active pieces
    are those at u = 0, and their sum is held.
    """
    if not laws or is_number(bound, 0.0):
        return []
    loose, own = add_laws([law for law in laws if not law.has_bounds]), [law for law in laws if law.has_bounds]
    if len(own) == 1 and is_number(loose.resistance, 0.0):
        law = own[0]  # of a motor without strength the others keep the bound alone
        force = select(less(LEAST_SCALE, law.scale), loose.force, clip(loose.force, -bound, bound))
        return [_share(law, force, bound), *([] if is_number(force, 0.0) else [loose._replace(force=force)])]
    whole = add_laws([loose, *(law.piece(0.0) for law in own)]) if own else loose
    if is_number(whole.resistance, 0.0):
        return [whole._replace(force=clip(whole.force, -bound, bound))]
    return [whole._replace(least=-bound, most=bound, symmetric=True)]


def _share(law: Law, beside: Value, bound: Value) -> Law:
    """Return a law with bounds that keep its sum with the force ``beside`` between -``bound`` and ``bound``, too."""
    weight = reciprocal(select(less(LEAST_SCALE, law.scale), law.scale, LEAST_SCALE))
    low, high = (end * weight for end in (-bound - beside, bound - beside))
    least, most = law.least, law.most
    even = isinstance(least, float) and isinstance(most, float) and least == -most
    return law._replace(
        least=low if least is None else clip(least, low, high),
        most=high if most is None else clip(most, low, high),
        symmetric=is_number(beside, 0.0) and (law.symmetric or even),
    )


def largest_force(laws: list[Law]) -> float:
    """Return the largest force that laws can add up to; infinite unless all their bounds are constants.

    An effort limit that is no smaller never acts, and is left out.
    """
    ends = [(law.scale, law.least, law.most) for law in laws]
    if not all(isinstance(x, float) for end in ends for x in end):
        return np.inf
    return sum(scale * max(abs(least), abs(most)) for scale, least, most in ends)  # type: ignore[arg-type, misc]


class JointLaws:
    """The laws of every dof of a scene for one step.

    Args:
        links: of the scene. Values that are ``variable``, or that differ between worlds, are inputs by their name.
        h: length of the step [s]; 0.0 gives the forces as they are, without what the step changes.
        q, qd: entries of the state that the laws start from; ``qd`` None is zero.
        ahead: entries of what a step adds to q if u = 0; None is h qd.
        target_q, target_qd: entries of the drives' targets, laid out as q and qd; None: the neutral ones, zero.
        actuators: returns the laws of a dof's actuators; None: they do not act.
    """

    def __init__(
        self,
        links: Links,
        h: Value,
        q: Callable[[int], Value],
        qd: Callable[[int], Value],
        drift: Callable[[int], Value] | None = None,
        target_q: Callable[[int], Value] | None = None,
        target_qd: Callable[[int], Value] = lambda dof: 0.0,
        actuators: Callable[[int], list[Law]] | None = None,
    ):
        self.links, self.scene, self.h, self.q, self.qd = links, links.scene, h, q, qd
        self.drift = drift or (lambda dof: h * qd(dof))
        self.target_q, self.target_qd = target_q or self._neutral, target_qd
        self.actuators = actuators or (lambda dof: [])

    def laws(self, link: Link) -> list[list[Law]]:
        """Return all laws of each dof of a link; those without bounds come first, added up."""
        every = []
        for i, dof in enumerate(link.dofs):
            unbounded = [*self._damper(dof), *self._spring(link, i, "joint_stiffness", self._rest)]
            drive, actuators = self._motors(link, i)
            found = [*drive, *self._limits(link, i), *self._friction(dof), *actuators]
            found += self._rate_limit(dof, unbounded + found)
            unbounded += [law for law in found if not law.has_bounds]
            every.append([add_laws(unbounded)] * bool(unbounded) + [law for law in found if law.has_bounds])
        return every

    def _motors(self, link: Link, i: int) -> tuple[list[Law], list[Law]]:
        """Return the laws of the drive of a dof of a link, and those of its actuators, within its effort limit."""
        dof = link.dofs[i]
        drive, actuators = self._drive(link, i), self.actuators(dof)
        effort = self.effort_limit(dof) if drive or actuators else None
        if effort is not None and actuators and (drive or not self.is_weak(dof, largest_force(actuators))):
            return [], limit_sum(drive + actuators, effort)
        return drive if effort is None else limit_sum(drive, effort), actuators

    def springs_and_motors(self, link: Link, i: int) -> list[Law]:
        """Return the laws of the spring, the drive and the actuators of a dof of a link."""
        drive, actuators = self._motors(link, i)
        return [*self._spring(link, i, "joint_stiffness", self._rest), *drive, *actuators]

    def passive(self, link: Link) -> list[Law]:
        """Return damper and spring of each dof of a link, added up."""
        return [
            add_laws([*self._damper(dof), *self._spring(link, i, "joint_stiffness", self._rest)])
            for i, dof in enumerate(link.dofs)
        ]

    def spring_energies(self, link: Link) -> list[Value]:
        """Return stiffness (q - rest)^2 / 2 of each dof of a link."""
        found = []
        for i, dof in enumerate(link.dofs):
            k = self.value("joint_stiffness", dof)
            displacement = 0.0 if is_number(k, 0.0) else self._displacement(link, i, self._rest)
            found.append(0.5 * k * (displacement * displacement))
        return found

    # -- values ----------------------------------------------------------------------------------------------------
    def value(self, name: str, index: int) -> Value:
        """Return a value of the scene by dof, or by coordinate for joint_rest_q."""
        column = self.scene.values[name][:, index]
        if name in self.links.variable or (column != column[0]).any():
            return self.links.graph.input(name, index)
        return self._constant(name, index, column[0])

    def _constant(self, name: str, index: int, value: float) -> Value:
        """Return a constant; segments of one make may keep it from folding, see :mod:`.shared_constants`."""
        constants = self.links.shared_constants
        return float(value) if constants is None else constants.of_scene(name, index, float(value))

    def _bound(self, name: str, dof: int, none: float) -> Value | None:
        """Return a bound; None if it is ``none`` or larger in all worlds, and stays so."""
        if name not in self.links.variable and (np.abs(self.scene.values[name][:, dof]) >= none).all():
            return None
        return self.value(name, dof)

    def range(self, dof: int) -> tuple[Value | None, Value | None]:
        """Return the lower and the upper limit of a dof, None where it has none."""
        low, high = (self._bound(f"joint_limit_{side}", dof, UNLIMITED) for side in ("lower", "upper"))
        return low, high

    def _most(self, name: str, dof: int) -> Value | None:
        """Return a bound of a force or a rate; one of DEFAULT_BOUND and more in some world has no effect there."""
        bound = self._bound(name, dof, DEFAULT_BOUND)
        some = name in self.links.variable or (self.scene.values[name][:, dof] >= DEFAULT_BOUND).any()
        return select(less(bound, DEFAULT_BOUND), bound, FREE) if bound is not None and some else bound

    def effort_limit(self, dof: int) -> Value | None:
        """Return the bound of the force that drive and actuators of a dof give together; None if there is none."""
        return self._most("joint_effort_limit", dof)

    def velocity_limit(self, dof: int) -> Value | None:
        """Return the bound of the rate of a dof; None if there is none."""
        return self._most("joint_velocity_limit", dof)

    def is_weak(self, dof: int, most: float) -> bool:
        """Return whether a force of the size ``most`` obeys the effort limit of a dof in all worlds, for good."""
        name = "joint_effort_limit"
        return name not in self.links.variable and bool((self.scene.values[name][:, dof] >= most).all())

    def _rest(self, coordinate: int) -> Value:
        return self.value("joint_rest_q", coordinate)

    def _neutral(self, coordinate: int) -> Value:
        return self._constant("neutral_q", coordinate, self.scene.neutral_q[coordinate])

    def inertia(self, dof: int) -> Value:
        """Return the inertia at a dof in the neutral configuration of world 0, all other dofs being free."""
        return self._constant("joint_inertia", dof, neutral_inertias(self.scene)[dof])

    # -- laws ------------------------------------------------------------------------------------------------------
    def _damper(self, dof: int) -> list[Law]:
        d = self.value("joint_damping", dof)
        return [] if is_number(d, 0.0) else [Law(-(d * self.qd(dof)), d)]

    def _spring(self, link: Link, i: int, name: str, rest: Callable[[int], Value]) -> list[Law]:
        """-k (q' - rest), q' = q + h (qd + u)"""
        k = self.value(name, link.dofs[i])
        if is_number(k, 0.0):
            return []
        displacement = self._displacement(link, i, rest)
        return [Law(-k * (displacement + self.drift(link.dofs[i])), self.h * k)]

    def _displacement(self, link: Link, i: int, rest: Callable[[int], Value]) -> Value:
        """Return q - rest of one dof of a link; of a rotation, an entry of its rotation vector."""
        first = link.coordinate
        return link.hinge.displacement(i, lambda c: self.q(first + c), lambda c: rest(first + c))

    def _drive(self, link: Link, i: int) -> list[Law]:
        """ke (target_q - q') + kd (target_qd - qd')"""
        dof = link.dofs[i]
        kd = self.value("joint_target_kd", dof)
        laws = self._spring(link, i, "joint_target_ke", self.target_q)
        laws += [] if is_number(kd, 0.0) else [Law(kd * (self.target_qd(dof) - self.qd(dof)), kd)]
        return [add_laws(laws)] if laws else []

    def _limits(self, link: Link, i: int) -> list[Law]:
        """Return springs that push back into the range and never pull; outside the range with dampers."""
        dof, laws = link.dofs[i], []
        for name, inward in (("joint_limit_lower", 1.0), ("joint_limit_upper", -1.0)):
            turns = link.hinge.quaternion is not None
            if turns and (np.abs(self.scene.values[name][:, dof]) >= UNLIMITED).all():
                continue  # variable or not: such a dof has no limits
            bound = self._bound(name, dof, UNLIMITED)
            if bound is None:
                continue
            if turns:
                label = self.scene.dof_labels[dof]
                raise UnsupportedError(
                    "Dynamics.step",
                    f"a limit on {label!r}, a dof of a ball or free hinge,",
                    f"leave {name} at {-inward * UNLIMITED:.0e} there",
                )
            depth = inward * (bound - self.q(link.coordinate + i))  # how far outside; positive there
            k, d = self.value("joint_limit_ke", dof), self.value("joint_limit_kd", dof)
            d = select(less(0.0, depth), d, 0.0)
            force = k * (depth - inward * self.drift(dof)) - d * (inward * self.qd(dof))
            least, most = (0.0, None) if inward > 0.0 else (None, 0.0)
            laws.append(Law(inward * force, self.h * k + d, least, most, 1.0, LIMIT, depth, k))
        return laws

    def _friction(self, dof: int) -> list[Law]:
        """Return a force of at most ``joint_friction`` against the motion; a damper below CREEP."""
        f = self.value("joint_friction", dof)
        return [] if is_number(f, 0.0) else [Law(-(1.0 / CREEP) * self.qd(dof), 1.0 / CREEP, -1.0, 1.0, f, FRICTION)]

    def _rate_limit(self, dof: int, others: list[Law]) -> list[Law]:
        """Return dampers on the excess over the velocity limit, HOLD times the inertia over the step.

        A dof without inertia takes the resistance of the ``others`` instead.
        """
        bound = self.velocity_limit(dof)
        if bound is None or is_number(self.h, 0.0):
            return []
        qd, inertia = self.qd(dof), self.inertia(dof)
        r = HOLD * inertia * reciprocal(self.h)
        if is_number(inertia, 0.0):
            r = HOLD * total(law.scale * law.resistance for law in others)
        return [Law(r * (bound - qd), r, None, 0.0), Law(-(r * (bound + qd)), r, 0.0, None)]


def is_number(x: Value, number: float) -> bool:
    return is_constant(x) and x == number


@cached_by_scene
def neutral_inertias(scene: Scene) -> np.ndarray:
    """Return 1 / diagonal of Mass^-1 at the neutral configuration of world 0 [dof]; of Mass where it is singular."""
    mass, inverse = masses(scene)
    with np.errstate(all="ignore"):
        found = 1.0 / np.diagonal(inverse)
    return np.where((found > 0.0) & (found <= np.diagonal(mass)), found, np.diagonal(mass))
