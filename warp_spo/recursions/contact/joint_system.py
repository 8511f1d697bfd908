"""Values of a state that the solver of touching bodies in joint space reads.

Beside the mass matrix these are poses and velocities of bodies, what dofs move, the bias force, the surfaces of the
ground at the points that may touch it, and what the laws of joints, pairs and points have in a world, of values that
are variable or differ between worlds. A surface's point moves along a parabola, as :mod:`.points` explains; the push
and the depth of its law say so.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value, is_constant, sqrt
from ...trace.spatial import IDENTITY, ZERO, Vector, dot, total
from ..kinematics import body_poses, body_velocities, columns, zero
from ..newton_euler import inverse_dynamics
from ..step import descendants
from ..step.actuation import build_joint_laws
from ..step.joint_laws import JointLaws, Law, add_laws
from .pairs import place_axes_of
from .points import place_points, with_ancestors

if TYPE_CHECKING:
    from ..model.tracing import Trace

VELOCITIES = "velocities"
SCREWS, SURFACES, OF_MOTORS = "screws", "surfaces", "motors"
OF_DOFS, OF_PAIRS = "dof_values", "pair_values"
PASSED = "passed"  # array [world, dof]: qd + h qdd, as the last pass leaves it
SCREW = 9  # entries of a dof: what its rate turns, and moves of the place whose coordinates follow, inertial axes
SURFACE = 11
"""Entries of a surface: place, normal, depth; push and damping of its law; gap; 1 where the point comes out slowly."""
LAW = 5
"""Entries of a law f(u) = scale clip(force - resistance u, least, most) of OF_MOTORS: force, resistance, least, most,
scale; UNBOUNDED where there is no bound."""
UNBOUNDED = 1e30
AWAY = -1e3  # depth of a point that cannot move [m]
LAWS = {
    "stiffness": "joint_stiffness", "damping": "joint_damping", "ke": "joint_target_ke", "kd": "joint_target_kd",
    "dry": "joint_friction", "lower": "joint_limit_lower", "upper": "joint_limit_upper",
    "limit_ke": "joint_limit_ke", "limit_kd": "joint_limit_kd",
}  # fmt: skip
"""Values of a dof by their names in the kernel and in the scene."""
OTHERS = (
    "joint_effort_limit", "joint_velocity_limit", "joint_rest_q", "contact_stiffness", "contact_damping",
    "contact_friction", "gravity",
)  # fmt: skip
"""Further values of the scene that laws read."""


def joint_states(trace: Trace) -> list[Store]:
    """out = poses of the bodies, VELOCITIES; SCREWS"""
    stores = body_poses(trace)
    stores += [item._replace(array=VELOCITIES) for item in body_velocities(trace)]
    return stores + _screws(trace, _origins(trace))


def joint_bias(trace: Trace) -> list[Store]:
    """out = bias force, with gravity compensation"""
    trace.compensate_gravity()
    return list(inverse_dynamics(trace, qdd=zero))


def joint_system(
    trace: Trace,
    surfaces: bool,
    pairs: tuple[int, ...],
    motors: tuple[int, ...],
    names: tuple[tuple[str, ...], tuple[str, ...]] | None = None,
) -> list[Store]:
    """out = bias force, with gravity compensation; SURFACES; OF_MOTORS; OF_DOFS, OF_PAIRS that are no constants

    ``surfaces``: whether points may touch the ground. ``names``: of the values of dofs, and of pairs; None: all are
    constants. ``pairs``: the order of the scene's pairs, after which the surfaces follow. ``motors``: by dof, how many
    laws of its spring, drive and actuators OF_MOTORS has.
    """
    trace.compensate_gravity()
    laws = build_joint_laws(trace, trace.graph.input("dt", 0))
    stores = list(inverse_dynamics(trace, qdd=zero, letter="f"))
    place_axes_of(trace, list(trace.links.links))
    numbers = _add_surfaces(trace, laws, _origins(trace), stores) if surfaces else []
    stores += _motor_laws(trace, laws, motors)
    if names is not None:
        first = len(trace.links.scene.contact_points)
        rows = [*(first + pair for pair in pairs), *numbers]
        stores += [*_dof_values(trace, laws, names[0]), *_pair_values(trace, laws, names[1], rows)]
    return stores


def state_after(trace: Trace) -> list[Store]:
    """out = qd', q_out = q' for the rates PASSED of the last pass

    Bodies that turn freely, and those on links that move, end as in steps by sweeps, see :mod:`..step.descendants`.
    """
    q, qd, passed, h = *map(trace.vector, ("q", "qd", PASSED)), trace.graph.input("dt", 0)
    rates = {dof: passed(dof) for link in trace.links.leaders for dof in link.dofs}
    stores: list[Store] = []
    for link, coordinates, after in descendants.states_after(trace, list(trace.links.leaders), q, qd, rates, h):
        stores += [Store("out", (dof,), rate) for dof, rate in zip(link.dofs, after, strict=True)]
        stores += [Store("q_out", (link.coordinate + c,), value) for c, value in enumerate(coordinates)]
    return stores


def _origins(trace: Trace) -> dict[int | None, Vector]:
    """Return where the frames of links that are placed lie, by id."""
    origins: dict[int | None, Vector] = {None: ZERO}
    for link in trace.active_links:
        trace.label(link, "y")
        own, over = trace.places[id(link)].pose.l, link.parent
        origins[id(link)] = own if over is None else origins[id(over)] + trace.axes[id(over)] @ own
    return origins


def _screws(trace: Trace, origins: dict[int | None, Vector]) -> list[Store]:
    """Return the stores of the motion of each dof, of the links that carry bodies."""
    found: list[Store] = []
    carriers = with_ancestors([placement.link for placement in trace.links.placements.values()])
    for link in trace.active_links:
        if id(link) not in carriers or not trace.exchange.own(link):
            continue
        trace.label(link, "j")
        parent = IDENTITY if link.parent is None else trace.axes[id(link.parent)]
        for dof, (w, v) in zip(
            link.dofs, columns(link, trace.places[id(link)], parent, trace.axes[id(link)], ZERO), strict=True
        ):
            found += [Store(SCREWS, (SCREW * dof + c,), x) for c, x in enumerate((*w, *v, *origins[id(link)]))]
    return found


def _add_surfaces(trace: Trace, laws: JointLaws, origins: dict[int | None, Vector], stores: list[Store]) -> list[int]:
    """Add the stores of the surfaces; return the number of the point of each."""
    points = place_points(trace, laws, trace.vector("qd"), oriented=True)
    for at, point in enumerate(points):
        trace.graph.step = f"contact {point.number}|y"
        still = point.link is None
        origin = ZERO if still else origins[id(point.link)]
        place = [x + dot(axis, point.arm) for x, axis in zip(origin, point.axes, strict=True)]
        normal = [dot(axis, point.normal) for axis in point.axes]
        law: list[Value] = [AWAY, 0.0, 0.0] if still else [point.depth, point.push, point.d]
        row = [*place, *normal, *law, point.gap, 0.0 if still else point.deep]
        stores += [Store(SURFACES, (SURFACE * at + i,), value) for i, value in enumerate(row)]
    return [point.number for point in points]


def _motor_laws(trace: Trace, laws: JointLaws, motors: tuple[int, ...]) -> list[Store]:
    found: list[Store] = []
    for link in trace.active_links:
        for i, dof in enumerate(link.dofs):
            if not motors[dof]:
                continue
            trace.label(link, "m")
            every = laws.springs_and_motors(link, i)
            loose = [law for law in every if not law.has_bounds]
            rows = [add_laws(loose)] * bool(loose) + [law for law in every if law.has_bounds]
            assert len(rows) <= motors[dof]
            rows += [Law(0.0, 0.0)] * (motors[dof] - len(rows))
            for at, law in enumerate(rows, start=sum(motors[:dof])):
                least = -UNBOUNDED if law.least is None else law.least
                most = UNBOUNDED if law.most is None else law.most
                values = (law.force, law.resistance, least, most, law.scale)
                found += [Store(OF_MOTORS, (LAW * at + c,), value) for c, value in enumerate(values)]
    return found


def _dof_values(trace: Trace, laws: JointLaws, names: tuple[str, ...]) -> list[Store]:
    found: list[Store] = []
    for link in trace.active_links:
        for i, dof in enumerate(link.dofs):
            values: dict[str, Value | None] = {name: laws.value(source, dof) for name, source in LAWS.items()}
            values["effort"], values["fastest"] = laws.effort_limit(dof), laws.velocity_limit(dof)
            if link.hinge.quaternion is None:
                values["rest"] = laws.value("joint_rest_q", link.coordinate + i)
            found += _varying(OF_DOFS, len(names) * dof, names, values)
    return found


def _pair_values(trace: Trace, laws: JointLaws, names: tuple[str, ...], rows: list[int]) -> list[Store]:
    found: list[Store] = []
    for at, row in enumerate(rows):
        values = {name: laws.value(f"contact_{name}", row) for name in ("stiffness", "damping", "friction")}
        found += _varying(OF_PAIRS, len(names) * at, names, values)
    half = {"gravity": 0.5 * sqrt(total(x * x for x in trace.links.gravity))}
    return found + _varying(OF_PAIRS, len(names) * len(rows), ("gravity",), half)


def _varying(array: str, first: int, names: Iterable[str], values: dict) -> list[Store]:
    """Return the stores of those ``values`` that are no constants, in the order of ``names``."""
    return [
        Store(array, (first + i,), values[name])
        for i, name in enumerate(names)
        if values.get(name) is not None and not is_constant(values[name])
    ]
