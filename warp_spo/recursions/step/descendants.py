"""The state after a step of free bodies on links that move: they keep their inertial velocity.

The rates of a free hinge are relative to its parent and in the parent's axes. Moved by their acceleration at the start
of the step alone, they miss what the parent turns and speeds up meanwhile: of a body at rest the error is of order dt^2
a step, in proportion to the parent's speed. So the body moves as a free body without a parent does, v' = v + h a in
inertial axes and its pose along v'; rates and coordinates follow from the parent's state after the step. A body on
which nothing acts stays at rest, whatever its parent does.

Where a law of the hinge or a contact acts on the body or on what it carries, it stays as it is: those are solved for
the rates relative to the parent, and would act on a state that the step does not take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

from ...hinges.quaternions import Quaternion, multiply, quaternion_rotation, rotate_by
from ...scene.scene import Scene
from ...trace.scalars import Value, absolute, is_constant, select
from ...trace.spatial import IDENTITY, ZERO, Matrix, Vector, cross, total
from ..coordinates import integrate_link
from ..kinematics import NEUTRAL, relative_quaternion
from ..model.links import Link, place_link
from ..motion import STILL, hinge_motion, link_motion
from ..newton_euler import link_acceleration
from .free_rotation import inertia_about_center, normalize, rotate_freely, turn_alone, turns_alone, turns_freely
from .joint_laws import DEFAULT_BOUND

if TYPE_CHECKING:
    from ..model.tracing import Trace

LAWS = tuple(f"joint_{law}" for law in ("stiffness", "damping", "friction", "target_ke", "target_kd"))
Entry = Callable[[int], Value]
Entries = dict[int, Value]


class InertialLink(NamedTuple):
    """A link in the inertial frame: its axes, their quaternion, its origin, and (omega; v) in inertial axes."""

    axes: Matrix
    turn: Quaternion
    origin: Vector
    spin: Vector
    velocity: Vector

    def velocity_at(self, point: Vector) -> Vector:
        """Return the velocity of the point of the link that is at ``point``."""
        return self.velocity + cross(self.spin, point - self.origin)


GROUND = InertialLink(IDENTITY, NEUTRAL, ZERO, ZERO, ZERO)


def free_descendants(scene: Scene) -> set[int]:
    """Return the first dofs of the free hinges on bodies that move, on which neither laws nor contacts act."""
    inner = {hinge.child: hinge for hinge in scene.hinges}

    def path(body: int) -> Iterator[int]:
        while body >= 0:
            yield body
            body = inner[body].parent

    points = [point.body for point in scene.contact_points]
    pairs = [body for pair in scene.contact_pairs for body in (pair.body, pair.other)]
    touched = {body for one in (*points, *pairs) for body in path(one)}
    found = set()
    for hinge, first in zip(scene.hinges, scene.qd_start, strict=False):
        dofs = slice(first, first + hinge.dof_count)
        moves = hinge.unconstrained and any(inner[body].dof_count for body in path(hinge.parent))
        if moves and hinge.child not in touched:
            has_laws = any(scene.values[name][:, dofs].any() for name in LAWS)
            has_laws |= bool((scene.values["joint_velocity_limit"][:, dofs] < DEFAULT_BOUND).any())
            found |= set() if has_laws else {int(first)}
    return found


def has_free_descendants(scene: Scene) -> bool:
    """Return whether a step of a scene may have to carry free bodies on links that move."""
    return bool(free_descendants(scene))


def states_after(
    trace: Trace, links: list[Link], q: Entry, qd: Entry, rates: Entries, h: Value, carries: bool = True
) -> Iterator[tuple[Link, list[Value], list[Value]]]:
    """Yield (link, coordinates, rates) after a step, for ``rates`` = qd + h qdd of all dofs.

    Args:
        links: leaders, parents first. q, qd: the state before the step.
        carries: free bodies on links that move are carried, as said above; otherwise their rates are those given.
    """
    q_after, qd_after = Entries(), dict(rates)
    free = free_descendants(trace.links.scene) if carries else set()
    carried = {id(link) for link in links if free.intersection(link.dofs)}
    gains = {dof: rate - qd(dof) for dof, rate in rates.items()} if carried else {}
    for link in links:
        trace.label(link, "q")
        if id(link) in carried:
            coordinates = _carry(link, q, qd, gains, q_after, qd_after, h)
            held = total(absolute(law) for law in _variable_laws(trace, link))
            if not is_constant(held):  # the values of a world may have laws where the scene's have none
                plain = integrate_link(link, q, rates.__getitem__, h)
                coordinates = [select(held, x, y) for x, y in zip(plain, coordinates, strict=True)]
                qd_after |= {dof: select(held, rates[dof], qd_after[dof]) for dof in link.dofs}
        elif carries and turns_alone(link, trace.links.scene):
            coordinates, found = turn_alone(link, q, qd, rates, h)
            qd_after |= zip(link.dofs, found, strict=True)
        else:
            coordinates = integrate_link(link, q, rates.__getitem__, h)
        q_after |= {link.coordinate + c: value for c, value in enumerate(coordinates)}
        yield link, coordinates, [qd_after[dof] for dof in link.dofs]


def _variable_laws(trace: Trace, link: Link) -> Iterator[Value]:
    """Yield those values of the laws of a link's hinge that may differ from the scene's."""
    for name in LAWS:
        if name in trace.links.variable:
            yield from (trace.graph.input(name, dof) for dof in link.dofs)


def _carry(
    link: Link, q: Entry, qd: Entry, gains: Entries, q_after: Entries, qd_after: Entries, h: Value
) -> list[Value]:
    """Return the coordinates of a free body after the step; ``qd_after`` receives its rates."""
    body, spin_gain, velocity_gain = _before(link, q, qd, gains, h)
    spin, velocity = body.spin + spin_gain, body.velocity + velocity_gain
    parent_before, parent = _after(link.parent, q, None), _after(link.parent, q_after.__getitem__, qd_after)
    at_rest = link.hinge.quaternion_at_rest(link)
    start, end = multiply(parent_before.turn, at_rest), multiply(parent.turn, at_rest)
    raw = Vector(q(link.coordinate + 3 + c) for c in range(4))
    if turns_freely(link):
        turn, spin = rotate_freely(inertia_about_center(link), body.axes, body.spin, spin_gain, h)
        turned = normalize(multiply(turn, multiply(start, raw)))
    else:
        turned = rotate_by(multiply(start, raw), spin * h)
    quaternion = multiply(Vector((-end[0], -end[1], -end[2], end[3])), turned)
    center = body.origin + velocity * h
    anchor = parent.axes if link.matrix is None else parent.axes @ link.matrix
    position = anchor.T @ (center - parent.origin - parent.axes @ link.offset)
    relative = (anchor.T @ (velocity - parent.velocity_at(center)), anchor.T @ (spin - parent.spin))
    qd_after |= dict(zip(link.dofs, (*relative[0], *relative[1]), strict=True))
    return [*(position - quaternion_rotation(*quaternion) @ link.com), *quaternion]


def _path(link: Link | None) -> list[Link]:
    """Return a link and its ancestors, root first."""
    found: list[Link] = []
    while link is not None:
        found.insert(0, link)
        link = link.parent
    return found


def _after(link: Link | None, q: Entry, qd: Entries | None) -> InertialLink:
    """Return a link at a state; ``qd`` None is at rest."""
    moving = GROUND
    for each in _path(link):
        place = place_link(each, q)
        axes = moving.axes @ place.pose.rotation
        origin = moving.origin + moving.axes @ place.pose.l
        turn = multiply(moving.turn, relative_quaternion(each, q))
        w, v = (ZERO, ZERO) if qd is None else hinge_motion(each, place, qd.__getitem__)
        moving = InertialLink(axes, turn, origin, moving.spin + axes @ w, moving.velocity_at(origin) + axes @ v)
    return moving


def _before(link: Link, q: Entry, qd: Entry, gains: Entries, h: Value) -> tuple[InertialLink, Vector, Vector]:
    """Return a link at the state before the step, and h times its angular and its linear acceleration."""
    moving, terms = GROUND, STILL
    bias, gained = (ZERO, ZERO), (ZERO, ZERO)
    for each in _path(link):
        place = place_link(each, q)
        axes = moving.axes @ place.pose.rotation
        origin = moving.origin + moving.axes @ place.pose.l
        w, v = hinge_motion(each, place, qd)
        moving = InertialLink(axes, NEUTRAL, origin, moving.spin + axes @ w, moving.velocity_at(origin) + axes @ v)
        terms = link_motion(each, place, terms if each.parent is not None else None, qd)
        bias = link_acceleration(each, place, terms, bias, lambda dof: 0.0)
        gained = link_acceleration(each, place, STILL, gained, gains.__getitem__)
    spin, velocity = (moving.axes @ (x * h + y) for x, y in zip(bias, gained, strict=True))
    return moving, spin, velocity
