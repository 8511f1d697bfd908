"""Contact points at a configuration: where the ground is, how they move, and what a damper there adds to the sweep.

A point that may touch two surfaces, a wall and a floor, counts as two.

A contact pushes with f = f0 - G v, where v is the point's velocity after the step. With v = v_before + h J qdd, the
damper h G is an inertia at the point and f0 - G v_before a load, see :mod:`.dampers`. G = across I + (along - across)
n n* is isotropic across the normal n, so that no tangent directions are needed. Vectors are in the axes of the point's
link.

A point's path within the step is a parabola: at rates that stay as they are it accelerates by n* J' qd = ``bend`` along
the normal, so that after the step it is h n* v + h^2 bend / 2 further out, and leaves the ground by h bend faster. The
spring and the damper see that. Without it a point of a segment that turns fast ends up to h^2 bend / 2 deeper than the
spring has worked for, and energy rises. Where velocity terms are kicks, all is half way, where J* is the mean along the
path: the point was half a step back before the step, along that path, and n* J v is its mean speed.

A point that begins deep inside comes out at PUSH_OUT at most, if its damping is chosen: the damper is so large that the
force is zero at that speed. A larger damper takes energy out whatever it is, and holds up what rests on the point.

A segment works on the points of its links. Those of the link on which other segments begin are shared among these in
equal numbers, and only the rest stays: they know that link's motion, and their messages to it carry what the points
add.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ...scene.contact_values import TURNING_VALUES
from ...scene.contacts import PUSH_OUT, ContactPoint
from ...scene.ground import AWAY, HEIGHTS, PLACE, HeightField, Listed
from ...scene.scene import Scene
from ...scene.supports import CORNER, HULL_CORNER
from ...trace.scalars import Entry, Value, absolute, branch, is_constant, less, lost, reciprocal, select
from ...trace.spatial import IDENTITY, ZERO, Twist, Vector, cross, dot, norm, total
from ..kinematics import arm_on_link, carried_velocity, frame_on_link, zero
from ..model import effective_mass
from ..model.links import Link, Links
from ..model.scene_cache import cached_by_scene
from ..model.segments import Segment
from ..model.tracing import Trace
from ..motion import VelocityTerms, hinge_motion, link_motion
from ..newton_euler import link_acceleration
from ..step.joint_laws import is_number
from .field_grid import ROW, GridPlace, Shape, find, search_field, touch
from .field_spheres import ring, sphere_surfaces
from .ground import Corners, GroundOffset, Surface, directions, has_walls, lowest, surface_count, surfaces, upward
from .supports import ROWS, SupportPlacement, hull_corners, place_corners, place_support
from .turning import TurningFriction, turning_names, turning_scales
from .velocity_kicks import KICK, PATH

if TYPE_CHECKING:
    from ..step.joint_laws import JointLaws

ARMS = 8  # spheres of a segment up to which their arms are kept, see docs/contact_measured.md
STANDING = (0.0, 0.0, 1.0)  # normal of the ground in a body's frame for which weights of points that move are taken
FASTER, REACHES = 5.0, 2.0  # speed that a step may add to a shape's [m/s]; way per speed and step that is looked down
SEEN = 5.0  # radii below a sphere's centre within which gaps are those of the nearest point
SLIP = 0.6  # share of a point's inverse weight by which friction beyond its bound predicts slip


@dataclasses.dataclass
class TracedContactPoint:
    """A contact point of a link.

    Attributes:
        number: of the scene's contact point. arm: from the link's origin. normal: of the ground there.
        gap: distance from the ground [m]. twist: (w; v) of the link before the step.
        k, d, mu: stiffness, damping, friction. eps: speed below which friction is a damper.
        weight: inverse weight that predicts slip [1/kg]. axes: of the inertial frame, in the link, where asked.
        depth, push: how far below ground it would be after a step that ends with n* J v = 0, and its normal force then.
        cell: of the height field, whose heights the ground has there; None on a plane.
        near: 1 where the surface is near, else 0; None: code shall not branch.
        lever: the arm is not longer [m]. turning: its torsional and rolling friction; None: it has neither.
        deep: 1 where the damping is larger than the scene's, so that the point comes out slowly, else 0.
    """

    number: int
    link: Link | None
    arm: Vector
    normal: Vector
    gap: Value
    twist: Twist
    k: Value
    d: Value
    mu: Value
    eps: Value
    weight: Value
    axes: list[Vector]
    depth: Value
    push: Value
    cell: Corners | None = None
    near: Value | None = None
    lever: Value = 0.0
    turning: TurningFriction | None = None
    deep: Value = 0.0

    def kept_values(self, arm: bool) -> list[Value]:
        """Return what passes keep: normal, depth, push, damping, motion of the link before; ``arm``: that, too.

        Damping that makes a point slow follows from the depth in four operations.
        """
        damping = [] if is_constant(self.d) or self.d.op == "input" or not is_constant(self.deep) else [self.d]
        kept = [*self.arm] if arm else []
        return [*kept, *self.normal, self.depth, self.push, *damping, *self.twist[0], *self.twist[1]]

    def restrict_to_near(self, *more: Value) -> tuple[TracedContactPoint, list[Value]]:
        """Return the point, and more values that are zero away from its surface; code computes both only near it."""
        if self.near is None or is_constant(self.near):
            return self, list(more)
        mask, name = self.near, f"surface of {self.number}"
        only = lambda x, away=0.0: branch(mask, x, away, name)  # noqa: E731
        values: dict[str, Any] = {} if is_constant(self.d) or self.d.op == "input" else {"d": only(self.d)}
        values |= {} if is_constant(self.deep) else {"deep": only(self.deep)}
        values |= dict(normal=Vector(only(x) for x in self.normal), gap=only(self.gap, -AWAY), push=only(self.push))
        depth, found = only(self.depth, AWAY), [only(x) for x in more]
        return dataclasses.replace(self, **values, depth=depth), found

    def works(self, candidate: Value) -> Value:
        """Return what is not zero where the point is a candidate, or its push is no number, which must be seen."""
        return candidate + lost(self.push)

    @property
    def velocity(self) -> Vector:
        """The point's velocity before the step."""
        return self.rate(*self.twist)

    def wrench(self, force: Vector) -> Vector:
        """Return (n; f) of a force at the point, about the link's origin."""
        return Vector((*cross(self.arm, force), *force))

    def rate(self, w: Vector, v: Vector) -> Vector:
        """Return the velocity of the point, or its acceleration, when the link moves with (w; v)."""
        return v + cross(w, self.arm)


class ContactLinkMotion(NamedTuple):
    """Motion at qdd = 0 of a link that carries points, in its axes.

    Attributes:
        axes: the directions of the ground. origins: where the link's origin is along them. twist: (omega; v).
        motion: velocity terms. bend: acceleration (omega'; v').
        travel: the twist along the path of the step, where that is another one.
    """

    axes: list[Vector]
    origins: list[Value]
    twist: Twist
    motion: VelocityTerms | None
    bend: Twist
    travel: Twist


def place_points(
    trace: Trace,
    joint_laws: JointLaws,
    qd: Entry,
    oriented: bool = False,
    branches: bool = False,
    gaps: bool = True,
    ahead: Value | None = None,
    carry: Callable[[Link, ContactLinkMotion], ContactLinkMotion] | None = None,
) -> list[TracedContactPoint]:
    """Return the contact points that a trace works on, one for each surface that a point may touch.

    ``oriented``: with the inertial directions x, y, z in the axes of their links. ``branches``: code may leave out
    points where their surface is not near. ``gaps``: somebody reads the gaps; a sphere over a field then looks SEEN
    radii far for the nearest point, otherwise only as far as the step may bring it, and a gap beyond is vertical.
    ``ahead``: the time [s] within which shapes have to touch the grid of a field to be seen there; None: what is left
    of the step. ``carry``: called with each link that leads to a point, and its motion; points and links further out
    read what it returns, as gradients want it that cut the trace into parts. None: the motion itself.
    """
    scene = trace.links.scene
    ground, weights = scene.ground, inverse_weights(scene)
    assert ground is not None
    half_way, still = KICK in trace.inputs, (ZERO, ZERO)
    h = joint_laws.h
    step_left = 0.5 * h if half_way else h
    ahead = step_left if ahead is None else ahead
    path = trace.vector(PATH) if half_way else qd
    place_of_ground = ground_offset(joint_laws)
    seats = {at: _contact_placement(trace, at, body, place) for at, body, place in _point_positions(trace, joint_laws)}
    needed = with_ancestors([link for link, _ in seats.values()] if carry is None else point_links(trace.links))
    asked = directions(ground)
    count = len(asked)
    asked = [*asked, *IDENTITY] if oriented and count < len(IDENTITY) else asked
    base = ContactLinkMotion(asked, [0.0] * count, still, None, still, still)
    carried = _carry_outward(trace, base, needed, qd, path, carry)
    found, searches = [], dict[int, tuple[Shape, list[Value]]]()  # by contact
    corners: dict[int, list[SupportPlacement]] = {}  # of hulls, likewise
    for number, (on, centre) in seats.items():
        point, mine = scene.contact_points[number], carried[None if on is None else id(on)]
        radius, eps, weight = point.radius, point.eps, weights[number]
        if trace.links.shared_constants is not None:
            radius, eps, weight = trace.links.shared_constants.of_point(number, "contact", (radius, eps, weight))
        trace.graph.step = f"contact {number}|c"
        toward = mine.axes[:count]
        rolls = meets_field_as_sphere(ground, point)
        down = toward[lowest(ground)]
        lever = radius + total(absolute(x) for x in centre)
        hub, more = centre, None
        grid: GridPlace | None = None
        there: Value = 1.0
        if point.meets_grid:
            assert isinstance(ground, HeightField) and point.support is not None
            if point.contact not in searches:
                at = [origin + dot(axis, centre) for origin, axis in zip(mine.origins, toward, strict=True)]
                way_down = _way_down(mine.travel, centre, total(_support_values(trace, number)[1]), ahead)
                shape = _shape_over(trace, number, ground, place_of_ground, at, toward, radius, way_down)
                searches[point.contact] = shape, find(trace.graph, ground, place_of_ground, shape)
            shape, rows = searches[point.contact]
            row = rows[ROW * point.support.number : ROW * (point.support.number + 1)]
            near = 1.0 if has_walls(ground, place_of_ground.varies) else None
            grid = touch(trace.graph, ground, place_of_ground, shape, row, near)
            lever = lever + point.support.reach
            centre = centre + Vector(
                total(x * axis[c] for x, axis in zip(grid.place, toward, strict=True)) for c in range(3)
            )
            hub = centre
        elif point.support is not None:
            if isinstance(ground, HeightField) and point.support.kind not in (CORNER, HULL_CORNER):
                at = [origin + dot(axis, centre) for origin, axis in zip(mine.origins, toward, strict=True)]
                up = upward(trace.graph, ground, at, place_of_ground)
                down = Vector(total(n * axis[c] for n, axis in zip(up, toward, strict=True)) for c in range(3))
            if point.support.kind == HULL_CORNER:
                if point.contact not in corners:
                    axes, _, _ = _support_values(trace, number)
                    if isinstance(ground, HeightField):
                        at = [origin + dot(axis, centre) for origin, axis in zip(mine.origins, toward, strict=True)]
                        shape = _shape_over(trace, number, ground, place_of_ground, at, toward, radius)
                        asked_of = (trace.graph, ground, place_of_ground, shape)
                        corners[point.contact] = place_corners(axes, search_field(*asked_of, "corners", 4 * ROWS))
                    else:
                        corners[point.contact] = hull_corners(trace.graph, point.support, axes, down)
                placed = corners[point.contact][point.support.number]
            else:
                placed = _place_support(trace, number, down)
            there = placed.there
            lever, more = lever + point.support.reach, placed.bend(mine.travel, mine.bend)
            centre, hub = centre + placed.offset, centre + placed.hub
        arm = centre if rolls or grid or is_number(radius, 0.0) else centre - down * radius
        place = centre if point.support is None else arm
        at = [origin + dot(axis, place) for origin, axis in zip(mine.origins, toward, strict=True)]
        if not rolls and point.support is None:
            at[lowest(ground)] = at[lowest(ground)] - radius
        k, d, mu = (joint_laws.value(f"contact_{name}", number) for name in ("stiffness", "damping", "friction"))
        turned = mine.axes[-len(IDENTITY) :] if oriented else []
        turning = _turning_friction(joint_laws, number, eps)
        moving = mine.motion
        bend = mine.bend[1] + cross(mine.bend[0], hub)
        bend = bend if moving is None else bend + moving.whirl @ hub
        w, v = mine.travel
        moves = [step_left * dot(axis, v + cross(w, centre)) for axis in toward]
        if isinstance(ground, Listed):
            touched = [_listed_surface(joint_laws, number)]
        elif grid is not None:
            touched = [grid.surface]
        elif rolls and isinstance(ground, HeightField):
            second = surface_count(ground, place_of_ground.varies, point.walls, rolls) == 2
            cells, field_below = ring(ground, point.radius), radius + _way_down(mine.travel, centre, radius, ahead)
            if gaps:
                field_below = select(less(field_below, SEEN * radius), SEEN * radius, field_below)
            touched = sphere_surfaces(trace.graph, ground, at, place_of_ground, radius, cells, second, field_below)
        else:
            touched = surfaces(trace.graph, ground, at, place_of_ground, moves, point.walls)
        for normal, depth, cell, near in touched:
            inward = Vector(total(n * axis[c] for n, axis in zip(normal, toward, strict=True)) for c in range(3))
            arm = centre - inward * radius if rolls else arm
            depth = select(there, depth, AWAY)
            speed_gained = h * (dot(inward, bend) if more is None else dot(inward, bend) + more)
            if half_way:  # half a step back, along a parabola
                depth = depth + (0.5 * h) * dot(inward, v + cross(w, arm)) - (0.125 * h) * speed_gained
            # of a whole step at whose end the point does not move along n: the parabola leads h^2 bend / 2 further out
            depth_after = depth if half_way else depth - (0.5 * h) * speed_gained
            damping = d * (k * select(less(0.0, depth), depth, 0.0)) if point.dissipates else d
            deep: Value = 0.0
            if point.is_slow and not isinstance(ground, Listed):
                slow = k * (depth_after * (1.0 / PUSH_OUT) - h)  # at PUSH_OUT the force is zero
                deep = less(damping, slow)
                damping = select(deep, slow, damping)
            material = k, damping, mu, eps, weight
            push = k * depth_after if half_way else k * depth_after - damping * speed_gained
            state: Any = (turned, depth_after, push, cell, near if branches else None, lever, turning, deep)
            found.append(TracedContactPoint(number, on, arm, inward, -depth, mine.twist, *material, *state))
    return found


def _turning_friction(joint_laws: JointLaws, number: int, eps: Value) -> TurningFriction | None:
    """Return torsional and rolling friction of a contact point, None without."""
    links = joint_laws.links
    names = turning_names(links.scene, links.variable, number)
    if not names:
        return None
    scale: Sequence[Value] = turning_scales(links.scene)[number]
    if links.shared_constants is not None:
        scale = links.shared_constants.of_point(number, "turning", scale)
    length, weight = scale
    torsional, rolling = (joint_laws.value(name, number) if name in names else None for name in TURNING_VALUES)
    return TurningFriction((torsional, rolling), eps * reciprocal(length), length, weight)


def _carry_outward(
    trace: Trace,
    base: ContactLinkMotion,
    needed: set[int],
    qd: Entry,
    path: Entry,
    carry: Callable[[Link, ContactLinkMotion], ContactLinkMotion] | None,
) -> dict[int | None, ContactLinkMotion]:
    """Return what the ``needed`` links carry, by id, from the ``base`` outward; what the base carries is under None.

    ``path``: the rates along which q moves in the step; qd itself where that is no other path.
    """
    carried: dict[int | None, ContactLinkMotion] = {None: base}
    for link in trace.active_links:
        if id(link) not in needed:
            continue
        trace.label(link, "n")
        over, place = carried[None if link.parent is None else id(link.parent)], trace.places[id(link)]
        axes = [place.pose.to_child(axis) for axis in over.axes]
        origins = [at + dot(axis, place.pose.l) for at, axis in zip(over.origins, over.axes, strict=False)]
        twist = carried_velocity(place, over.twist, hinge_motion(link, place, qd))
        travel = carried_velocity(place, over.travel, hinge_motion(link, place, path)) if path is not qd else twist
        move = link_motion(link, place, over.motion, path)
        own = ContactLinkMotion(
            axes, origins, twist, move, link_acceleration(link, place, move, over.bend, zero), travel
        )
        carried[id(link)] = own if carry is None else carry(link, own)
    return carried


def surface_numbers(scene: Scene, varies: bool) -> list[range]:
    """Return the numbers of the surfaces that each contact point may touch; ``varies``: heights are variable."""
    counts = [
        surface_count(scene.ground, varies, point.walls, meets_field_as_sphere(scene.ground, point))
        for point in scene.contact_points
    ]
    ends = itertools.accumulate(counts)
    return [range(end - count, end) for end, count in zip(ends, counts, strict=True)]


def meets_field_as_sphere(ground: Any, point: ContactPoint) -> bool:
    """Return whether a point is a sphere that touches where a height field is nearest."""
    return isinstance(ground, HeightField) and point.radius > 0.0 and point.support is None


def _shape_over(
    trace: Trace,
    number: int,
    ground: HeightField,
    place: GroundOffset,
    middle: list[Value],
    toward: list[Vector],
    radius: Value,
    below: Value = 0.0,
) -> Shape:
    """Return the shape of a point over a field; ``middle``: of the shape, ``toward``: the inertial axes in its link.

    ``below``: by how much the field may be below it [m].
    """
    support = trace.links.scene.contact_points[number].support
    assert support is not None
    axes, sizes, _ = _support_values(trace, number)
    centre = Vector(x - place.origin[c] - ground.origin[c] for c, x in enumerate(middle))
    turned = [Vector(dot(way, axis) for way in toward) for axis in axes]
    return Shape(support.kind, centre, turned, sizes, radius, below, support.table)


def _way_down(twist: Twist, middle: Vector, size: Value, time: Value) -> Value:
    """Return how far below a shape [m] the ground may be that it touches within a time [s].

    ``twist``: of its link. ``middle``: of the shape in the link. ``size``: how far the shape reaches from there [m].
    """
    w, v = twist
    return time * (REACHES * (norm(v + cross(w, middle)) + norm(w) * size) + FASTER)


def _place_support(trace: Trace, number: int, normal: Vector) -> SupportPlacement:
    """Return where a point is that moves over its shape; ``normal`` of the ground in the axes of the point's link."""
    support = trace.links.scene.contact_points[number].support
    assert support is not None
    axes, sizes, signs = _support_values(trace, number)
    return place_support(support, axes, sizes, signs, normal)


def _support_values(trace: Trace, number: int) -> tuple[list[Vector], list[Value], list[Value]]:
    """Return axes of a point's shape in its link, sizes and signs of its support."""
    point, constants = trace.links.scene.contact_points[number], trace.links.shared_constants
    assert point.support is not None
    turn = trace.links.placements[point.body].matrix @ trace.links.nodes[point.body].anchor[0].T
    axes: list[Value] = [x for axis in point.support.axes for x in turn @ Vector(axis)]
    sizes: list[Value] = list(point.support.sizes)
    signs: list[Value] = list(point.support.signs)
    if constants is not None:
        if all(map(is_constant, axes)):
            axes = constants.of_point(number, "axes", axes)
        sizes = constants.of_point(number, "sizes", sizes)
        signs = constants.of_point(number, "signs", signs)
    return [Vector(axes[i : i + 3]) for i in (0, 3, 6)], sizes, signs


def point_links(links: Links) -> list[Link | None]:
    """Return the links that carry the scene's contact points."""
    return [links.placements[point.body].link for point in links.scene.contact_points]


def own_points(trace: Trace) -> list[tuple[int, ContactPoint]]:
    """Return the contact points that a trace works on, with their numbers."""
    exchange = trace.exchange
    return _all_points(trace.links) if exchange.alone else points_of(trace.links, exchange.own_segments[0])


def keeps_arms(trace: Trace) -> bool:
    """Return whether passes keep the arms of points, rather than find each from the normal anew, in three operations.

    Where segments share the work they do, unless a segment has so many spheres that registers run out.
    """
    segments = trace.exchange.segments if trace.exchange.shares_code else []
    spheres = (sum(point.radius > 0.0 for _, point in points_of(trace.links, segment)) for segment in segments)
    return max(spheres, default=0) <= ARMS


def _all_points(links: Links) -> list[tuple[int, ContactPoint]]:
    return list(enumerate(links.scene.contact_points))


def points_of(links: Links, segment: Segment) -> list[tuple[int, ContactPoint]]:
    """Return the contact points that a segment works on, with their numbers."""
    on: dict[int | None, list[tuple[int, ContactPoint]]] = {}
    for number, point in _all_points(links):
        link = links.placements[point.body].link
        on.setdefault(None if link is None else id(link), []).append((number, point))
    found = on.get(None, []) if segment.index == 0 else []
    for link in segment.links:
        mine = on.get(id(link), [])
        each = len(mine) // len(segment.children) if segment.children and link is segment.links[-1] else 0
        found += mine[each * len(segment.children) :]
    if segment.parent is not None:
        shared, sharers = on.get(id(segment.parent.links[-1]), []), segment.parent.children
        each, first = len(shared) // len(sharers), sharers.index(segment)
        found += shared[first * each : (first + 1) * each]
    return found


def _contact_placement(trace: Trace, number: int, body: int, place: tuple) -> tuple[Link | None, Vector]:
    """Return the link that carries a contact point, and the point in the link's frame."""
    constants, placement = trace.links.shared_constants, trace.links.placements[body]
    if constants is None or (body, tuple(place)) in trace.links.ports:
        return frame_on_link(trace, body, place)
    arm = arm_on_link(trace, body, place)
    fixed = placement.offset + arm  # where the body's place in its link varies, only the arm is a constant
    arm = Vector(0.0 if is_constant(x) else y for x, y in zip(fixed, arm, strict=True))
    free = placement.offset + Vector(constants.of_point(number, "arm", arm))
    fixed = Vector(constants.of_point(number, "centre", fixed))
    return placement.link, Vector(
        y if is_constant(o) else x for o, x, y in zip(placement.offset, free, fixed, strict=True)
    )


def _point_positions(trace: Trace, joint_laws: JointLaws) -> Iterator[tuple[int, int, tuple]]:
    """Yield number, body and place in the body frame of the contact points that a trace works on."""
    listed = isinstance(trace.links.scene.ground, Listed)
    for number, point in own_points(trace):
        given = tuple(joint_laws.value("contact_place", PLACE * number + i) for i in range(3)) if listed else ()
        yield number, point.body, given or point.position


def _listed_surface(joint_laws: JointLaws, number: int) -> Surface:
    """Return the surface near a point that the scene's values describe."""
    *normal, depth = (joint_laws.value("contact_place", PLACE * number + i) for i in range(3, PLACE))
    return Surface(Vector(normal), depth)


def ground_offset(joint_laws: JointLaws) -> GroundOffset:
    """Return where the ground is, from the scene's values.

    It is nowhere, at a height that is NaN, in a world that asks for a field which the set lacks, and where the field is
    moved aside by NaN, which no cell would show.
    """
    ground, sets = joint_laws.scene.ground, joint_laws.scene.values["ground_field"].size
    origin = Vector(joint_laws.value("ground_origin", i) for i in range(3))
    field = joint_laws.value("ground_field", 0) if sets else 0.0
    if isinstance(ground, HeightField) and not is_constant(field):
        there = less(-0.5, field) * less(field, ground.count - 0.5)
        origin = Vector([*origin[:2], origin[2] + lost(reciprocal(there))])
    if isinstance(ground, HeightField):
        origin = Vector([*origin[:2], origin[2] + lost(origin[0]) + lost(origin[1])])
    return GroundOffset(origin, field, HEIGHTS in joint_laws.links.variable)


def with_ancestors(links: list[Link | None]) -> set[int]:
    found: set[int] = set()
    for one in links:
        link = one
        while link is not None and id(link) not in found:
            found.add(id(link))
            link = link.parent
    return found


@cached_by_scene
def inverse_weights(scene: Scene) -> list[float]:
    """Return SLIP times the mean of J Mass^-1 J* over three directions, of each point, neutral, in world 0 [1/kg]."""
    frames = tuple((point.body, tuple(point.place(STANDING).tolist())) for point in scene.contact_points)
    return (SLIP / 3.0 * effective_mass.inverse_weights(scene, frames)).tolist()
