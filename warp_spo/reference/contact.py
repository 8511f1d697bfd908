"""The specification of a time step with contacts: dense float64 NumPy for one world, deliberately simple.

A contact is a spring, a damper and friction between a point of a body and the ground, all implicit: its force is
f = f0 - G J v, with the velocity v = qd' after the step, a positive semidefinite G [3, 3] and the spring's load f0
along the normal n, both of which see the point's path bend as its links turn. A step solves, with the pose held,

    (Mass + h S + h J* G J + h R* B R) v = Mass qd + h (tau - bias + l + J* f0),

where S and l are resistances and loads of the hinges' laws, and -B R v is the moment of torsional and rolling friction
on the body that turns with R v. G, B, S and l depend on v; each pass takes them from the v of the pass before.
Friction, effort limits and dry friction are secants: dampers that give the bound at the v before. The
first pass closes all candidates, later passes open those that pull, the last of three or more only closes. It takes
the secants at the v before the step.

A step of four passes or more takes two iterations of as many passes. Each finds the kick k = -h Mass^-1 c(u, v) / 2
half way along u, where c(u, v) = c((u + v) / 2) - c((u - v) / 2) are velocity terms of the mean v of qd and of the
rates after the step, along a path u, as the previous iteration found both. Passes without velocity terms, at the same
place, then take qd + k to u, along which q moves, and the rates after the step are u + k. At the end both k become that
of the u and v which the last iteration found. How much faster a dof gets that a saturated drive lets go follows from
each pass's own sweep.
"""

from typing import NamedTuple

import numpy as np

from .dense import Dense
from .field_cells import cell_at, cell_corners
from .field_grid import find, touched
from .field_spheres import nearest_points
from .rotations import homogeneous
from .supports import support_path

CREEP = 1e-4  # rate below which dry friction is a damper [rad/s, m/s]
UNBOUNDED, UNLIMITED = 1e6, 1e10  # effort and velocity limits, position limits, of this size and more are none
HOLD = 300.0  # resistance of a velocity limit, in inertias over the step
MIDPOINT_PASSES = 4  # passes from which on a step uses the midpoint scheme
ITERATIONS = 2  # of as many passes each
AWAY = -1e3  # depth of a surface that is not there [m]
FASTER, REACHES = 5.0, 2.0  # speed that a step may add to a shape's [m/s]; way per speed and step that is looked down
PUSH_OUT = 1.0  # speed [m/s] at most at which a point that is slow comes out of the ground
SLIP = 0.6  # share of a point's inverse weight by which friction beyond its bound predicts slip
LENGTH, LEAST_LENGTH = 0.1, 3e-5  # of a body that cannot turn, or whose point cannot move; what is too short to be one


class Points(NamedTuple):
    """Contact points at one pose: J [point, 3, dof] and n [point, 3] in inertial axes, the others [point].

    ``depth`` is the penetration [m], ``weight`` 0.6 of the inverse weight at the neutral pose [1/kg]. ``bend`` is
    n* J' qd, the acceleration along the normal at rates that stay as they are [m/s^2]: after the step the point is
    h n* J v + h^2 bend / 2 further out, and leaves the ground at n* J v + h bend.

    ``R`` [point, 3, dof] gives how the point's body turns. Columns of ``turning`` [point, 4] are the coefficients of
    torsional and rolling friction [m], the length [m] over which eps is the rate below which they are dampers, and 0.6
    of the inverse weight of turning at the neutral pose [1/(kg m^2)].
    """

    J: np.ndarray
    n: np.ndarray
    depth: np.ndarray
    k: np.ndarray
    d: np.ndarray
    mu: np.ndarray
    eps: np.ndarray
    weight: np.ndarray
    bend: np.ndarray | float = 0.0
    R: np.ndarray | None = None
    turning: np.ndarray | None = None

    def that_turn_freely(self):
        """Return the points without torsional and rolling friction."""
        return self._replace(R=np.zeros_like(self.J), turning=np.tile([0.0, 0.0, 1.0, 0.0], (len(self.k), 1)))

    def after(self, at, h):
        """Return the depths after the step, for the velocities ``at``."""
        return self.depth - h * _along(self.n, at) - 0.5 * h * h * self.bend

    def push(self, at, h):
        """Return the normal forces of closed points after the step [N], negative where one would pull."""
        return self.k * self.after(at, h) - self.d * (_along(self.n, at) + h * self.bend)


class Limits(NamedTuple):
    """Position limits [limit]: the dof, which way it is pushed (1 or -1), how far it is outside, stiffness, damping."""

    dof: np.ndarray
    way: np.ndarray
    depth: np.ndarray
    k: np.ndarray
    d: np.ndarray


class Laws(NamedTuple):
    """Laws of the dofs, forces ``load - resistance v`` [dof]; a drive's is s (a - v), at most ``effort``.

    ``dry`` is the bound of dry friction, ``fastest`` a velocity limit and ``brake`` its resistance; ``weight`` is the
    diagonal of Mass^-1 at the neutral pose.
    """

    load: np.ndarray
    resistance: np.ndarray
    s: np.ndarray
    a: np.ndarray
    effort: np.ndarray
    dry: np.ndarray
    fastest: np.ndarray
    brake: np.ndarray
    weight: np.ndarray


class PassResult(NamedTuple):
    """After the last pass: v [dof]; f, moment [point, 3]; excess of cone, adhesion [N] and effort; what was closed.

    A moment beyond its bound counts in the excess of cones over the point's length.
    """

    v: np.ndarray
    f: np.ndarray
    excess: np.ndarray
    on: np.ndarray
    moment: np.ndarray


def solve(M, laws, limits, points, v, load, h, passes=3, gravity=0.0, outward=None):
    """Return what the passes find for the velocity ``v`` before the step and the hinges' forces ``load`` [dof].

    ``outward`` by dof: the dofs that it carries, [dof] of bool; of these dofs weights come from each pass's sweep.
    """
    start, kd = v, points.k * h + points.d
    points = points if points.R is not None else points.that_turn_freely()
    at, still = points.J @ v, np.zeros_like(points.n)
    candidate = np.maximum(points.after(at, h), points.after(still, h)) + 0.5 * gravity * h * h > 0.0
    fn = candidate * np.maximum(0.0, points.push(at, h))
    w, turn = _slip(points.n, at), _turns(points, v)
    drive_s, dry_w = clamped(laws, v, np.zeros(len(v)), h), np.abs(v)
    on = limit_on = None
    for number in range(passes):
        first, last = number == 0, number == passes - 1 and passes >= 3
        if not first:
            candidate = candidate | (points.after(at, h) > 0.0)
        closed = candidate & (first | (points.push(at, h) > 0.0))
        inward = limits.way * v[limits.dof]
        held = limits.depth + h * np.maximum(0.0, -inward) > 0.0
        if not first:
            held = limits.k * limits.depth - (h * limits.k + limits.d) * inward > 0.0
        by_rule = np.zeros_like(held)
        if last:
            closed, by_rule = closed | on, limit_on & ~held
        on, limit_on = closed, held | by_rule
        G, (B, turners) = dampers(points, on, kd, fn, w), turn_dampers(points, fn, turn)
        f0 = (on * points.push(still, h))[:, None] * points.n
        S, l = laws.resistance.copy(), laws.load.copy()
        S, l = S + drive_s, l + drive_s * laws.a
        dry_s = laws.dry / np.sqrt(dry_w**2 + CREEP**2)
        S = S + dry_s
        depth = np.where(by_rule, np.maximum(limits.depth, 0.0), limits.depth)
        np.add.at(S, limits.dof, limit_on * (h * limits.k + limits.d))
        np.add.at(l, limits.dof, limit_on * limits.way * limits.k * depth)
        fast = np.abs(v) > laws.fastest
        S, l = S + fast * laws.brake, l + fast * laws.brake * np.sign(v) * np.where(fast, laws.fastest, 0.0)
        A = M + h * np.diag(S) + h * np.einsum("pai,pab,pbj->ij", points.J, G, points.J)
        A = A + h * np.einsum("pai,pab,pbj->ij", points.R, B, points.R)
        v = np.linalg.solve(A, M @ start + h * (load + l + np.einsum("pai,pa->i", points.J, f0)))
        at = points.J @ v
        f = f0 - np.einsum("pab,pb->pa", G, at)
        fn, ft = np.maximum(0.0, _along(points.n, f)), _slip(points.n, f)
        w = _slip(points.n, at) + h * points.weight * np.maximum(0.0, ft - points.mu * fn)
        turn, moment = _turns(points, v), -np.einsum("pab,pb->pa", B, points.R @ v)
        twisted = np.maximum(0.0, turners * turn - points.turning[:, :2] * fn[:, None])
        turn = turn + h * points.turning[:, 3:] * twisted
        force = drive_s * (laws.a - v)
        beyond = np.maximum(0.0, np.abs(force) - laws.effort)
        felt = laws, laws
        if outward is not None:
            felt = tuple(laws._replace(weight=felt_weights(A, outward, h * s, laws.weight)) for s in (drive_s, dry_s))
        drive_s = clamped(felt[0], v, force, h)
        dry_w = np.abs(v) + h * felt[1].weight * np.maximum(0.0, dry_s * np.abs(v) - laws.dry)
    cone, adhesion = ft - points.mu * fn, -_along(points.n, f)
    cone = np.append(cone, twisted / points.turning[:, 2:3])
    excess = np.array([np.maximum(x, 0.0).max(initial=0.0) for x in (cone, adhesion, beyond)])
    return PassResult(v, f, excess, on, moment)


def felt_weights(A, outward, own, weight):
    """Return ``weight`` [dof] with what some dofs feel if nothing further in moves and without their ``own`` damper.

    1 over their pivots in A, eliminated from the outside in, less ``own``.
    """
    found = weight.copy()
    for i, beyond in outward.items():
        D = A[i, i] - A[i, beyond] @ np.linalg.solve(A[np.ix_(beyond, beyond)], A[beyond, i])
        found[i] = 1.0 / max(D - own[i], 1e-12 * D)
    return found


def dampers(points, on, kd, fn, w):
    """Return G [point, 3, 3]: the damper along n of closed points, and friction's secant across it."""
    across = points.mu * fn / np.sqrt(w**2 + points.eps**2)
    nn = points.n[:, :, None] * points.n[:, None, :]
    return across[:, None, None] * (np.eye(3) - nn) + (on * kd)[:, None, None] * nn


def turn_dampers(points, fn, w):
    """Return B [point, 3, 3], and its resistances along n and across it [point, 2], for the rates ``w`` [point, 2]."""
    mu, slow = points.turning[:, :2], points.eps / points.turning[:, 2]
    found = mu * fn[:, None] / np.sqrt(w**2 + slow[:, None] ** 2)
    nn = points.n[:, :, None] * points.n[:, None, :]
    return found[:, :1, None] * nn + found[:, 1:, None] * (np.eye(3) - nn), found


def _turns(points, v):
    """Return the rates at which the points' bodies spin about n and roll across it [point, 2]."""
    turning = points.R @ v
    return np.stack([np.abs(_along(points.n, turning)), _slip(points.n, turning)], axis=1)


def clamped(laws, v, force, h):
    """Return the resistances of the drives that give at most their effort at the velocities ``v``."""
    w = np.abs(v - laws.a) + h * laws.weight * np.maximum(0.0, np.abs(force) - laws.effort)
    return np.minimum(laws.s, np.divide(laws.effort, w, out=np.full(len(w), np.inf), where=w > 0.0))


def _along(n, x):
    return np.einsum("pa,pa->p", n, x)


def _slip(n, x):
    return np.linalg.norm(x - _along(n, x)[:, None] * n, axis=1)


def surfaces(field, at, number=0, moves=(0.0, 0.0, 0.0), walls=True):
    """Return normal and depth of the surfaces of a height field near a point that the step takes by ``moves``.

    They are the field's own, or a floor and a wall where the middle slope of the cell exceeds 1. The wall is the plane
    that touches the cell there, and ends at its highest corner. Beyond an edge the field is level across it. A cell
    without a wall is followed by the wall of the cell where the step takes the point, if that rises along ``moves``. Of
    a set of fields it is that of this number. Without ``walls`` they are the field's own.
    """
    h, place = field.heights.reshape(-1, *field.heights.shape[-2:])[number], at[:2] - field.origin[:2]
    place, ahead = place / field.cell, (place + moves[:2]) / field.cell
    z = at[2] - field.origin[2]
    upward = lambda slope: np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)  # noqa: E731

    def cell(inside):
        """The corners of the cell, its slope in the middle, and where ``place`` is in it."""
        first = cell_at(inside, h.shape)
        corners = cell_corners(h, first)
        middle = np.array([corners[1] - corners[0], corners[:, 1] - corners[:, 0]]).mean(axis=1) / field.cell
        return corners, middle, place - first

    def over(corners, s, t):
        """The height of a cell's surface at a place, and its slope there."""
        height = np.array([1.0 - s, s]) @ corners @ np.array([1.0 - t, t])
        slope_x = np.array([1.0 - t, t]) @ (corners[1] - corners[0])
        slope_y = np.array([1.0 - s, s]) @ (corners[:, 1] - corners[:, 0])
        return height, np.array([slope_x, slope_y]) / field.cell

    def wall(corners, inside):
        """The plane that touches a cell where it is nearest to the place, and its slope."""
        nearest = np.clip(inside, 0.0, 1.0)
        height, slope = over(corners, *nearest)
        plane = height + slope @ (np.array(field.cells) * (inside - nearest))
        return [(upward(slope), (plane - z) * upward(slope)[2])] if z <= corners.max() else [], slope

    corners, middle, (s, t) = cell(place)
    if walls and np.linalg.norm(middle) > 1.0:
        return [(np.array([0.0, 0.0, 1.0]), corners.min() - z), *wall(corners, np.array([s, t]))[0]]
    height, slope = over(corners, s, t)
    corners, middle, inside = cell(ahead)
    found, rising = wall(corners, inside)
    rises = walls and np.linalg.norm(middle) > 1.0 and rising @ moves[:2] > 0.0
    return [(upward(slope), (height - z) * upward(slope)[2]), *(found if rises else [])]


def upward(field, at, number=0):
    """Return the normal of a field over or under a place, the vertical where its cell is a floor and a wall."""
    normal = surfaces(field, at, number)[0][0]
    return normal


class ContactStep:
    """One step of a scene with contacts in one world.

    Args:
        scene: a Scene with contact_points and a ground.
        q, qd: the state [coordinate], [dof]. h: length of the step [s].
        target_q, target_qd: of the drives; None: the neutral q, zero.
        start: q before the step, if ``q`` is half way along the rates ``path``; None: ``q`` is before the step.
    """

    def __init__(self, scene, q, qd, h, target_q=None, target_qd=None, world=0, start=None, path=None):
        self.scene, self.h, self.world, self.half_way = scene, h, world, start is not None
        self.start = Dense(scene, q if start is None else start, world=world)
        self.dense, self.qd = Dense(scene, q, qd, world), np.asarray(qd, dtype=np.float64)
        self.neutral = Dense(scene, scene.neutral_q)
        self.points, self.limits = self._points(self.qd if path is None else path), self._limits()
        self._targets = target_q, target_qd
        target_q = scene.neutral_q if target_q is None else target_q
        self.laws = self._laws(target_q, np.zeros(scene.dof_count) if target_qd is None else target_qd)

    def run(self, tau=None, body_f=None, passes=3):
        """Return q' and what the passes find."""
        dense, tau = self.dense, 0.0 if tau is None else np.asarray(tau)
        if passes < MIDPOINT_PASSES or self.scene.contact_pairs:
            found = self._passes(tau - dense.bias_force(self.qd, body_f), passes)
            return dense.integrate(found.v, self.h), found
        u = rates = self.qd
        for _ in range(ITERATIONS):
            half, kick = self._kick(u, rates)
            there = ContactStep(
                self.scene, half, self.qd + kick, self.h, *self._targets, self.world, start=dense.q, path=u
            )
            load = tau - there.dense.bias_force(np.zeros(len(u)), body_f) + there._lift(there.dense) - self._lift(dense)
            found = there._passes(load, passes, self._outward)
            u, rates = found.v, found.v + kick
        rates = rates + 2.0 * (self._kick(u, rates)[1] - kick)
        return dense.integrate(u, self.h), found._replace(v=rates)

    def _kick(self, u, rates):
        """Return the coordinates half way along ``u``, and half of what velocity terms add to the rates.

        ``rates``: after the step.
        """
        v, half = 0.5 * (self.qd + rates), self.dense.integrate(u, 0.5 * self.h)
        middle = Dense(self.scene.with_values(gravity=np.zeros(3)), half, v, self.world)
        terms = middle.bias_force(0.5 * (u + v)) - middle.bias_force(0.5 * (u - v))
        return half, -0.5 * self.h * np.linalg.solve(middle.mass_matrix, terms)

    @staticmethod
    def _lift(dense):
        """Return the part of passive_force that holds up bodies [dof]."""
        scene = dense.scene.with_values(body_gravcomp=np.zeros(len(dense.scene.bodies)))
        still = np.zeros(dense.dof_count)
        return dense.passive_force(still) - Dense(scene, dense.q, world=dense.world).passive_force(still)

    def _passes(self, load, passes, outward=None):
        """Return what the passes find for the hinges' forces ``load`` [dof]."""
        gravity = np.linalg.norm(self.dense.value("gravity"))
        system = self.dense.mass_matrix, self.laws, self.limits, self.points, self.qd
        return solve(*system, load, self.h, passes, gravity, outward)

    @property
    def _outward(self):
        """The dofs that a dof carries, of each hinge that has one dof; none where links share dofs."""
        dense, tree, bodies = self.dense, self.scene.tree, range(len(self.scene.bodies))
        dofs = [np.arange(dense.dof_count)[dense.dofs[i]] for i in bodies]
        single = [] if self.scene.shares_dofs else [i for i in bodies if len(dofs[i]) == 1]
        found = {}
        for i in single:
            beyond = np.zeros(dense.dof_count, dtype=bool)
            beyond[[dof for j in bodies if j != i and tree.is_ancestor(i, j) for dof in dofs[j]]] = True
            found[int(dofs[i][0])] = beyond
        return found

    def _points(self, path):
        """Return the points, which move along ``path``.

        One that may touch a wall and a floor is two, and ``numbers`` says of which point.
        """
        dense, ground, rows, self.numbers = self.dense, self.scene.ground, [], []
        plane, moved = not hasattr(ground, "heights"), dense.value("ground_origin")
        field = dense.value("ground_field")
        inverse = np.linalg.pinv(self.neutral.mass_matrix)
        for number, point in enumerate(self.scene.contact_points):
            which = int(field[0]) if len(field) else 0
            middle = (dense.body_matrix[point.body] @ homogeneous([*point.position, 0, 0, 0, 1]))[:3, 3]
            up = np.array(ground.normal if plane else (0.0, 0.0, 1.0))
            if point.support is not None and not plane and point.support.kind not in ("corner", "hull corner"):
                up = upward(ground, middle - moved, which)
            grid = self._grid_touch(point, middle, moved, which, path)
            seat, hub, more = self._support_place(point, up, path) if grid is None else (grid[2], grid[2], 0.0)
            is_there = grid is not None or point.support is None or self._is_there(point, up)
            if point.support is not None and not plane and point.support.kind == "hull corner":
                *place, is_there = self._field_row(point, middle, moved, which, path)
                seat = hub = point.position + np.array(point.support.axes).T @ place
            at = (dense.body_matrix[point.body] @ homogeneous([*seat, 0, 0, 0, 1]))[:3, 3]
            bending = dense.jacobian_bias(path, [(point.body, (*hub, 0, 0, 0, 1))])[0, :3]
            share = 0.5 if self.half_way else 1.0
            moves = share * self.h * dense.jacobian([(point.body, (*seat, 0, 0, 0, 1))])[0, :3] @ path
            centre, rolls = at, point.radius > 0.0 and not plane and point.support is None
            at = at if rolls or grid is not None else at - point.radius * up
            typical = point.place((0.0, 0.0, 1.0))
            there = self.neutral.jacobian([(point.body, (*typical, 0, 0, 0, 1))])[0]
            weight, turn_weight = (SLIP * np.trace(part @ inverse @ part.T) / 3.0 for part in (there[:3], there[3:]))
            moves_and_turns = min(weight, turn_weight) > 0.0 and weight / turn_weight > LEAST_LENGTH**2
            length = np.sqrt(weight / turn_weight) if moves_and_turns else LENGTH
            k, d, mu = (dense.value(f"contact_{name}")[number] for name in ("stiffness", "damping", "friction"))
            turning = [dense.value(f"contact_{name}_friction")[number] for name in ("torsional", "rolling")]
            turning += [length, turn_weight]
            if plane:
                touches = [(np.array(ground.normal), ground.height - (at - moved) @ ground.normal)]
            elif grid is not None:
                touches = [grid[:2]]
            elif rolls:
                touches = nearest_points(ground, at - moved, point.radius, which, point.walls and self._touches_twice)
            else:
                touches = surfaces(ground, at - moved, which, moves, point.walls)
            touches = [(normal, depth if is_there else AWAY) for normal, depth in touches]
            for normal, depth in touches:
                at = centre - point.radius * normal if rolls else at
                J, bend = dense._jacobian_at(point.body, at), normal @ bending + more
                if self.half_way:  # half a step back
                    depth = depth + 0.5 * self.h * normal @ J[:3] @ path - 0.125 * self.h**2 * bend
                    bend = 0.0
                damping = d * k * max(depth, 0.0) if point.dissipates else d
                if point.is_slow:  # the force is zero at PUSH_OUT
                    damping = max(damping, k * ((depth - 0.5 * self.h**2 * bend) / PUSH_OUT - self.h))
                rows.append((J[:3], normal, depth, k, damping, mu, point.eps, weight, bend, J[3:], turning))
                self.numbers.append(number)
        return Points(*(np.array(column) for column in zip(*rows, strict=True)))

    def _grid_touch(self, point, middle, moved, which, path):
        """Return normal, depth and place in the body of a point that touches a field's grid; None: of another one.

        ``middle``: of its shape. It is AWAY where the search found nothing.
        """
        support, ground = point.support, self.scene.ground
        if support is None or not support.meets_grid:
            return None
        pose, start, cell = self.dense.body_matrix[point.body], np.array(ground.origin) + moved, np.array(ground.cells)
        axes, shape = np.array(support.axes) @ pose[:3, :3].T, support.kind.partition(" ")[0]
        heights = ground.heights.reshape(-1, *ground.heights.shape[-2:])
        row = self._field_row(point, middle, moved, which, path)
        found = touched(shape, heights[which], cell, middle - start, axes, support.sizes, point.radius, row)
        if found is None:
            return np.array([0.0, 0.0, 1.0]), AWAY, np.array(point.position)
        return *found[:2], pose[:3, :3].T @ (found[2] + start - pose[:3, 3])

    def _field_row(self, point, middle, moved, which, path):
        """Return the row that a search in the field finds for a point of a shape which moves along ``path``."""
        support, ground, turn = point.support, self.scene.ground, self.dense.body_matrix[point.body][:3, :3]
        shape = "corners" if support.kind == "hull corner" else support.kind.partition(" ")[0]
        heights = ground.heights.reshape(-1, *ground.heights.shape[-2:])
        twist = self.dense.jacobian([(point.body, (*point.position, 0, 0, 0, 1))])[0] @ path
        speed = np.linalg.norm(twist[:3]) + np.linalg.norm(twist[3:]) * np.sum(support.sizes)
        below = self.h * (REACHES * speed + FASTER)
        numbers = [which * heights[0].size, *(middle - ground.origin - moved), *(support.axes @ turn.T).ravel()]
        numbers += [*support.sizes, *ground.cells, *heights[0].shape, below, *support.table]
        return find(shape, heights.ravel(), numbers)[support.number]

    def _is_there(self, point, up):
        return point.support.is_there(self.dense.body_matrix[point.body][:3, :3].T @ up)

    def _support_place(self, point, up, path):
        """Return a point that moves over its shape, the material one whose path counts, and its further bend.

        ``up``: the ground's normal, inertial axes. The first two are in the body frame.
        """
        if point.support is None:
            return point.position, point.position, 0.0
        pose, frame = self.dense.body_matrix[point.body], [(point.body, (*point.position, 0, 0, 0, 1))]
        turn, w = pose[:3, :3], self.dense.jacobian(frame)[0, 3:] @ path
        hub, more = support_path(point.support, turn, up, w, self.dense.jacobian_bias(path, frame)[0, 3:])
        seat = point.position + point.support.offset(turn.T @ up)
        return seat, point.position + turn.T @ hub, more

    @property
    def _touches_twice(self):
        """Whether a sphere may touch two places of the field."""
        return self.scene.ground.has_walls or self.scene.ground.has_creases

    def _positions(self):
        """Return the coordinate of each dof; NaN of those without one."""
        found, scene = np.full(self.dense.dof_count, np.nan), self.scene
        for hinge, q, v in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
            if hinge.kind not in ("ball", "free"):
                found[v : v + hinge.dof_count] = self.start.q[q : q + hinge.dof_count]
        return found

    def _limits(self):
        value, at, rows = self.dense.value, self._positions(), []
        for name, way in (("lower", 1.0), ("upper", -1.0)):
            bound = value(f"joint_limit_{name}")
            for dof in np.flatnonzero((np.abs(bound) < UNLIMITED) & np.isfinite(at)):
                depth = way * (bound[dof] - at[dof])
                damping = value("joint_limit_kd")[dof] if depth > 0.0 else 0.0
                rows.append((dof, way, depth, value("joint_limit_ke")[dof], damping))
        columns = np.array(rows).reshape(-1, 5).T
        return Limits(columns[0].astype(int), *columns[1:])

    def _laws(self, target_q, target_qd):
        value, dense, h, n = self.start.value, self.start, self.h, self.start.dof_count
        ke, kd, effort = value("joint_target_ke"), value("joint_target_kd"), value("joint_effort_limit")
        stiff, damp, lift = value("joint_stiffness"), value("joint_damping"), np.zeros(len(self.scene.bodies))
        drives = self.scene.with_values(
            **{name: array[min(self.world, len(array) - 1)] for name, array in self.scene.values.items()}
        ).with_values(joint_stiffness=ke, joint_damping=np.zeros(n), joint_rest_q=target_q, body_gravcomp=lift)
        s = (h * ke + kd) * (effort > 0.0)
        pull = Dense(drives, dense.q).passive_force(np.zeros(n)) + kd * target_qd  # at v = 0
        a = np.divide(pull, s, out=np.zeros(n), where=s > 0.0)
        inertia = 1.0 / np.diag(np.linalg.inv(self.neutral.mass_matrix))
        fastest = np.where(value("joint_velocity_limit") < UNBOUNDED, value("joint_velocity_limit"), np.inf)
        return Laws(
            load=dense.passive_force(np.zeros(n)),
            resistance=damp + h * stiff,
            s=s,
            a=a,
            effort=np.where(effort < UNBOUNDED, effort, np.inf),
            dry=value("joint_friction"),
            fastest=fastest,
            brake=np.where(np.isfinite(fastest), HOLD * inertia / h, 0.0),
            weight=1.0 / inertia,
        )
