"""Constraint rows of loop joints and couplings: g(q) = 0, Y qd = 0, Y qdd + Y' qd = 0.

The rows of a loop joint are formed in the frame of the lowest link that carries both of its anchors, as if that link
stood still: positions are then no larger than the loop, and the motion of the robot as a whole does not enter. A row is
a direction of the relative twist of the anchors, (omega; v) at the child anchor, that the joint does not allow. All
vectors are in the axes of that lowest link.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ...errors import UnsupportedError
from ...scene.parts import Coupling, Loop, in_plane
from ...scene.scene import Scene
from ...trace.evaluation import evaluate
from ...trace.scalars import Entry, Value, less, reciprocal
from ...trace.spatial import IDENTITY, ZERO, Matrix, Vector, cross, dot, total
from .. import articulated
from ..model.links import BodyPlacement, Link, LinkPlacement, Links, place_link
from ..model.scene_cache import cached_by_scene
from ..motion import hinge_motion, own_bias

PARALLEL = 1e-6  # sine of the angle between two axes of a loop joint, below which they are one
OPEN = 1e-5  # [rad], or distance over arm; a larger error is an open closure. Float32 rounds a few turns by less
VANISHES = 1e-20  # share of the squares of the distances that cancel in a size; a smaller size is rounding
SLOW = 1e-4  # [rad/s, m/s]; slower rates are not judged: the rates of a rigid truss are rounding alone


FixedSizes = tuple[float | None, float | None]


class LinkState(NamedTuple):
    """Position and motion of a link: axes, origin; angular velocity, velocity of the origin; their rates."""

    axes: Matrix
    origin: Vector
    spin: Vector
    velocity: Vector
    spin_rate: Vector
    acceleration: Vector


REST = LinkState(IDENTITY, ZERO, ZERO, ZERO, ZERO, ZERO)


class ConstraintRow(NamedTuple):
    """A direction (w; v) of the relative twist at the child anchor, and the rate of w; v turns with the parent."""

    w: Vector
    v: Vector
    w_rate: Vector


@dataclasses.dataclass
class CouplingConstraint:
    """A coupling: qd[follower] = ratio qd[leader].

    Attributes:
        follower, leader: links. path: the links between them and their lowest common ancestor; the ancestor too, if it
            is one of the two.
    """

    follower: Link
    leader: Link
    ratio: float
    offset: float
    path: list[Link]

    rows = 1

    def error(self, places: Any, q: Entry) -> list[Value]:
        return [q(self.follower.coordinate) - self.ratio * q(self.leader.coordinate) - self.offset]

    def jacobian(self, places: Any) -> list[dict[int, Value]]:
        return [{self.follower.dofs[0]: 1.0, self.leader.dofs[0]: -self.ratio}]

    def sizes(self, places: Any) -> list[Value]:
        return [1.0 + self.ratio * self.ratio]

    def acceleration(self, places: Any, qd: Any, qdd: Entry) -> list[Value]:
        return [qdd(self.follower.dofs[0]) - self.ratio * qdd(self.leader.dofs[0])]


class Closure:
    """A loop joint.

    Args:
        links: of the scene.
        loop: the joint.
        fixed_sizes: sizes of rows that slide and of rows that turn, where those of the motion are rounding; see
            :meth:`sizes`.

    Raises:
        UnsupportedError: a joint whose directions depend on how often it was turned round (helical), or whose axes are
            parallel.
    """

    def __init__(self, links: Links, loop: Loop, fixed_sizes: FixedSizes = (None, None)):
        self.fixed_sizes = fixed_sizes
        self.inner, self.outer = (
            links.placement(loop.parent, loop.parent_pose),
            links.placement(loop.child, loop.child_pose),
        )
        inner, outer = _ancestors(self.inner.link), _ancestors(self.outer.link)
        while inner and outer and inner[0] is outer[0]:
            del inner[0], outer[0]
        self.inner_path, self.outer_path = inner, outer
        self.path = inner + outer
        self.slides, self.held, self.crossed = _directions(loop)
        self.rows = len(self.slides) + len(self.held) + len(self.crossed)

    # -- positions -------------------------------------------------------------------------------------------------
    def error(self, places: dict[int, LinkPlacement], q: Any) -> list[Value]:
        """Return g: distances [m], and angles [rad] as twice the tangent of their half, zero only at zero."""
        inner, outer = self._anchors(places)
        back = inner.axes.T
        r = back @ (outer.origin - inner.origin)
        R = back @ outer.axes
        values = [dot(e, r) for e in self.slides]
        if len(self.held) == 3:
            scale = 2.0 * reciprocal(1.0 + R[0][0] + R[1][1] + R[2][2])
            turn = Vector((R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]))
            values += [dot(e, turn) * scale for e in self.held]
        elif self.held:
            axis = cross(*self.held)
            scale = 2.0 * reciprocal(1.0 + dot(axis, R @ axis))
            values += [dot(e, cross(axis, R @ axis)) * scale for e in self.held]
        values += [dot(first, R @ second) - dot(first, second) for first, second in self.crossed]
        return values

    # -- rates -----------------------------------------------------------------------------------------------------
    def jacobian(self, places: dict[int, LinkPlacement]) -> list[dict[int, Value]]:
        """Return Y, each row by dof."""
        inner, outer = self._anchors(places)
        found: list[dict[int, Value]] = [{} for _ in range(self.rows)]
        rows = self._rows(inner, outer)
        for dof, w, v, _ in self._columns(places, outer):
            for entries, row in zip(found, rows, strict=True):
                value = dot(row.w, w) + dot(row.v, v)
                entries[dof] = entries[dof] + value if dof in entries else value
        return found

    def sizes(self, places: dict[int, LinkPlacement]) -> list[Value]:
        """Return, for each row of Y, the sum of squares of the twists that it is a projection of.

        Where no motion moves the joint in any configuration, as that of a door's second hinge, the sum is rounding.
        The square of the distances that cancel in it takes its place, and 1 where rotations do.
        """
        sliding, turning = self.sums_of_squares(places)
        sliding, turning = (
            found if fixed is None else fixed for found, fixed in zip((sliding, turning), self.fixed_sizes, strict=True)
        )
        return [sliding] * len(self.slides) + [turning] * (self.rows - len(self.slides))

    def sums_of_squares(self, places: dict[int, LinkPlacement]) -> tuple[Value, Value]:
        """Return the sums of squares of velocities [m^2], and of angular velocities, over unit rates of all dofs."""
        _, outer = self._anchors(places)
        turning, sliding = 0.0, 0.0
        for _, w, v, _ in self._columns(places, outer):
            turning, sliding = turning + dot(w, w), sliding + dot(v, v)
        return sliding, turning

    def rounding_scale(self, places: dict[int, LinkPlacement]) -> Value:
        """Return the sum of squares of the distances from which the joint's velocities are computed [m^2].

        A sum of squared velocities below VANISHES times it is rounding, see :meth:`sizes`.
        """
        inner, outer = self._anchors(places)
        arms = [arm for _, _, _, arm in self._columns(places, outer)]
        return total(dot(far, far) for far in (inner.origin, outer.origin, *arms))

    def _columns(
        self, places: dict[int, LinkPlacement], outer: LinkState
    ) -> Iterator[tuple[int, Vector, Vector, Vector]]:
        """Yield (dof, w, v, arm): the relative twist at the child anchor per unit rate of each dof, and its arm."""
        for path, sign in ((self.inner_path, -1.0), (self.outer_path, 1.0)):
            for link, state in zip(path, self._states(path, places), strict=True):
                arm = outer.origin - state.origin
                for dof, H in zip(link.dofs, articulated.columns(link, places[id(link)]), strict=True):
                    w, v = state.axes @ Vector(H[:3]), state.axes @ Vector(H[3:])
                    yield dof, w * sign, (v + cross(w, arm)) * sign, arm

    def acceleration(self, places: dict[int, LinkPlacement], qd: Any, qdd: Entry) -> list[Value]:
        """Return Y qdd + Y' qd; ``qd`` None is zero."""
        inner, outer = self._anchors(places, qd, qdd)
        w, v = outer.spin - inner.spin, outer.velocity - inner.velocity
        arm = outer.origin - inner.origin  # of the point of the parent that is at the child anchor
        v = v - cross(inner.spin, arm)
        a = outer.acceleration - inner.acceleration - cross(inner.spin_rate, arm)
        a = a - cross(inner.spin, cross(inner.spin, arm) + 2.0 * v)
        rate = outer.spin_rate - inner.spin_rate
        rows = self._rows(inner, outer)
        return [dot(row.w, rate) + dot(row.w_rate, w) + dot(row.v, a) for row in rows]

    def _rows(self, inner: LinkState, outer: LinkState) -> list[ConstraintRow]:
        rows = [ConstraintRow(ZERO, inner.axes @ e, ZERO) for e in self.slides]
        for e in self.held:
            w = inner.axes @ e
            rows.append(ConstraintRow(w, ZERO, cross(inner.spin, w)))
        for first, second in self.crossed:
            a, b = inner.axes @ first, outer.axes @ second
            rate = cross(cross(outer.spin, b), a) + cross(b, cross(inner.spin, a))
            rows.append(ConstraintRow(cross(b, a), ZERO, rate))
        return rows

    def _anchors(
        self, places: dict[int, LinkPlacement], qd: Any = None, qdd: Any = None
    ) -> tuple[LinkState, LinkState]:
        inner, outer = (
            _state_of_anchor(self._states(path, places, qd, qdd)[-1] if path else REST, anchor)
            for path, anchor in ((self.inner_path, self.inner), (self.outer_path, self.outer))
        )
        return inner, outer

    def _states(
        self, path: list[Link], places: dict[int, LinkPlacement], qd: Any = None, qdd: Any = None
    ) -> list[LinkState]:
        """Return the position and motion of each link of a path, relative to the common link."""
        found, state = [], REST
        for link in path:
            state = _state_of_link(link, places[id(link)], state, qd, qdd)
            found.append(state)
        return found


def _state_of_link(link: Link, place: LinkPlacement, over: LinkState, qd: Any, qdd: Any) -> LinkState:
    pose = place.pose
    axes, d = over.axes @ pose.rotation, over.axes @ pose.l
    spin, velocity, rate, acceleration = over.spin, over.velocity, over.spin_rate, over.acceleration
    acceleration = acceleration + cross(rate, d) + cross(spin, cross(spin, d))
    velocity = velocity + cross(spin, d)
    if qd is not None:
        w, v = (axes @ part for part in hinge_motion(link, place, qd))
        rate = rate + cross(spin, w)
        acceleration = acceleration + 2.0 * cross(spin, v)
        own = own_bias(link, place, qd)
        if own is not None:
            rate, acceleration = rate + axes @ own[0], acceleration + axes @ own[1]
        spin, velocity = spin + w, velocity + v
    if qdd is not None:
        w, v = (axes @ part for part in hinge_motion(link, place, qdd))
        rate, acceleration = rate + w, acceleration + v
    return LinkState(axes, over.origin + d, spin, velocity, rate, acceleration)


def _state_of_anchor(link: LinkState, anchor: BodyPlacement) -> LinkState:
    s = link.axes @ anchor.offset
    velocity = link.velocity + cross(link.spin, s)
    acceleration = link.acceleration + cross(link.spin_rate, s) + cross(link.spin, cross(link.spin, s))
    return LinkState(link.axes @ anchor.matrix, link.origin + s, link.spin, velocity, link.spin_rate, acceleration)


def _ancestors(link: Link | None) -> list[Link]:
    """Return a link and its ancestors, root first."""
    found: list[Link] = []
    while link is not None:
        found.insert(0, link)
        link = link.parent
    return found


def _directions(loop: Loop) -> tuple[list[Vector], list[Vector], list[tuple[Vector, Vector]]]:
    """Return the constraints of a loop joint, in its parent anchor's axes.

    Directions along which the anchors do not slide; axes about which they do not turn; pairs of axes, one fixed in each
    anchor, whose angle stays constant.
    """
    call = f"Loop({loop.label!r})" if loop.label else f"Loop({loop.kind!r})"
    turns = [np.array(axis) for axis, angular, _ in loop.screws if angular]
    slides = [np.array(axis) for axis, angular, _ in loop.screws if not angular]
    if loop.kind == "helical":
        raise UnsupportedError(
            call,
            "a helical joint that closes a loop",
            "make it a hinge of the tree and close the loop at another joint",
        )
    if loop.kind in ("ball", "free"):
        turns = list(np.eye(3))
    if loop.kind == "free":
        slides = list(np.eye(3))
    for axes in (slides, turns):
        near = len(axes) == 2 and np.linalg.norm(np.cross(axes[0], axes[1])) < PARALLEL
        far = len(axes) == 3 and abs(np.linalg.det(axes)) < PARALLEL
        if near or far:
            raise UnsupportedError(call, "a loop joint with axes that are not independent", "leave out one of them")
    if len(turns) == 3 and max(abs(turns[0] @ turns[1]), abs(turns[1] @ turns[2])) > PARALLEL:
        raise UnsupportedError(call, "a loop joint with three oblique axes of turning", "use a ball")
    free = {0: list(np.eye(3)), 3: []}
    across = free.get(len(slides)) or ([] if len(slides) == 3 else _complement(slides))
    held = free.get(len(turns)) or (list(in_plane(turns[0])) if len(turns) == 1 else [])
    pairs = [(Vector(turns[0].tolist()), Vector(turns[1].tolist()))] if len(turns) == 2 else []
    return [Vector(e.tolist()) for e in across], [Vector(e.tolist()) for e in held], pairs


def _complement(axes: list[np.ndarray]) -> list[np.ndarray]:
    if len(axes) == 1:
        return list(in_plane(axes[0]))
    normal = np.cross(axes[0], axes[1])
    return [normal / np.linalg.norm(normal)]


def closures(links: Links) -> list[Closure | CouplingConstraint]:
    """Return the constraints of a scene: of its loop joints, then of its couplings."""
    scene = links.scene
    by_dof = {dof: link for link in links.leaders for dof in link.dofs}
    found: list[Closure | CouplingConstraint] = [
        Closure(links, loop, fixed) for loop, fixed in zip(scene.loops, _fixed_sizes(scene), strict=True)
    ]
    for coupling in scene.couplings:
        follower, leader = (by_dof[int(scene.qd_start[h])] for h in (coupling.hinge, coupling.reference))
        found.append(_coupling_constraint(follower, leader, coupling))
    return found


@cached_by_scene
def _fixed_sizes(scene: Scene) -> list[FixedSizes]:
    """Return what takes the place of the :meth:`Closure.sizes` of each loop joint that are rounding, None for others.

    A sum of squares of velocities [m^2] is rounding where it is below VANISHES times the squared distances that cancel
    in it, and one of angular velocities where it is below VANISHES, in each of a few random configurations.
    """
    links, rng = Links(one_world(scene)), np.random.default_rng(0)
    joints, sums = [Closure(links, loop) for loop in scene.loops], []
    places = {id(link): place_link(link, lambda c: links.graph.input("q", c)) for link in links.links}
    values = [x for joint in joints for x in (*joint.sums_of_squares(places), joint.rounding_scale(places))]
    for _ in range(3):
        q = scene.neutral_q + rng.uniform(-1.0, 1.0, len(scene.neutral_q))
        found = evaluate(values, lambda _, index, q=q: q[index[0]])  # type: ignore[misc]
        sums.append(np.array(found, dtype=float).reshape(-1, 3))
    of_velocities, of_angular, rounding_scales = np.max(sums, axis=0).T if joints else np.zeros((3, 0))
    return [
        (
            float(scale) if velocities <= VANISHES * scale else None,
            1.0 if angular <= VANISHES else None,
        )
        for velocities, angular, scale in zip(of_velocities, of_angular, rounding_scales, strict=True)
    ]


def one_world(scene: Scene) -> Scene:
    """Return a scene with the values of world 0 in all worlds."""
    one = {name: array[0] for name, array in scene.values.items() if array.shape[0] > 1}
    return scene.with_values(**one) if one else scene


def count_open_rows(
    constraints: list[Closure | CouplingConstraint], places: dict[int, LinkPlacement], q: Entry, qd: Entry
) -> Value:
    """Return how many rows are open by more than OPEN: in g relative to its size, or in Y qd relative to the rates."""
    found = []
    for constraint in constraints:
        dofs = [dof for link in constraint.path for dof in link.dofs]
        speed = SLOW**2 + total(qd(dof) * qd(dof) for dof in dofs)
        rows = zip(constraint.error(places, q), constraint.jacobian(places), constraint.sizes(places), strict=True)
        for error, row, size in rows:
            rate = total(x * qd(dof) for dof, x in row.items())
            found += [less(OPEN**2 * size, error * error), less(OPEN**2 * size * speed, rate * rate)]
    return total(found)


def _coupling_constraint(follower: Link, leader: Link, coupling: Coupling) -> CouplingConstraint:
    a, b = _ancestors(follower), _ancestors(leader)
    while len(a) > 1 and len(b) > 1 and a[0] is b[0]:
        del a[0], b[0]
    path = a + [link for link in b if all(link is not other for other in a)]
    return CouplingConstraint(follower, leader, float(coupling.ratio), float(coupling.offset), path)
