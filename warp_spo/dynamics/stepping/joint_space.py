"""A step of a scene whose bodies touch, solved in joint space by :mod:`warp_spo.kernels.joint_space`."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from ...execution.joint_tables import find_obstacle, joint_tables, motor_laws, way_out
from ...execution.routine import Routine, SegmentForm, TuningHints
from ...kernels import convex_pairs, convex_shapes, joint_space, near_pairs
from ...recursions.contact import coupled, joint_system
from ...recursions.contact.pairs import PASSES
from ...recursions.contact.points import surface_numbers
from ...recursions.contact.step import TOLERANCE
from ...runtime import launches
from ...scene.contact_shapes import BOX, CYLINDER, ELLIPSOID, SWEPT_SEGMENT, ConvexShape
from ...scene.ground import HEIGHTS
from ...scene.scene import Scene
from ..convex_contacts import PairShape, rotate, shape_rows
from ..inertia import MASS_MATRIX_PACKED

if TYPE_CHECKING:
    from ..dynamics import Dynamics

STATES = Routine("joint_states", joint_system.joint_states, segments=SegmentForm(wide=True))
BIAS = Routine("joint_bias", joint_system.joint_bias, segments=SegmentForm(messages="z"), hints=TuningHints(short=True))
SYSTEM = Routine("joint_system", joint_system.joint_system)
STATE_AFTER = Routine("joint_state_after", joint_system.state_after)
FEW, MOST_SHARED, NARROW, WIDE = 1024, 96 * 1024, 16, 32
"""A world takes a quarter of a warp where there are at most NARROW dofs, half a warp otherwise; with up to FEW worlds
twice as much. It takes a whole one where there are over WIDE dofs, and where a warp of two worlds would take over
MOST_SHARED bytes of shared memory; see docs/measured_facts.md."""
ROOM = 227 * 1024  # shared memory of a block [bytes]
MARGIN = 5e-3  # how near shapes are looked at whatever their speeds [m]; a drive at 1000 m/s^2 moves so far in 3 ms
TINY = 1e-9  # radius of a point among shapes [m]
PAIR_SOLVERS = ("joint space",)  # that a caller may ask for
NO_ROOM = "more dofs and contacts than the shared memory of the GPU holds of a world"
NO_ROOM_WAY = "use dtype='float32', or list fewer pairs"
NEAR, NEAR_A_BODY = 256, 4
"""Pairs that may be near in a world: so many, or so many for each body of a pair. One takes 240 bytes in float32."""
FULL, LEAST, LEAST_A_BODY, A_TREE = 8, 16, 2, 4
"""Of FULL pairs, or of as many as there are bodies of a pair, all points have slots. In a pile a body lies on one or
two others, mostly with four points. Where shared memory is short, LEAST slots, or LEAST_A_BODY for each body, stay.
On a GPU worlds with up to A_TREE points for each tree of bodies have a kernel with no more slots, of which many run
at once."""


def is_generated(dyn: Dynamics) -> bool:
    """Return whether generated code solves the pairs of bodies: they tie few links, or nothing can move."""
    if dyn.scene.dof_count == 0:
        return True
    return dyn.pair_solver is None and coupled.is_supported(dyn.programs.builder.links)


def check_pair_solver(call: str, given: Any) -> None:
    """Raise ValueError unless it names a solver of pairs of bodies, or None."""
    if given is not None and not (isinstance(given, str) and given in PAIR_SOLVERS):
        raise ValueError(f"{call}: pair_solver is {given!r}; expected None or {PAIR_SOLVERS[0]!r}")


def choose_solver(dyn: Dynamics) -> JointSpaceStep | None:
    """Return the solver of the pairs of bodies; None where there are none, generated code solves them, or no step."""
    if not dyn.scene.contact_pairs or is_generated(dyn) or find_obstacle(dyn.scene, dyn.variable):
        return None
    solver = JointSpaceStep(dyn)
    return solver if solver.fits else None


def reason_against(dyn: Dynamics) -> tuple[str, str]:
    """Return what of a scene keeps all steps from taking its pairs of bodies, and the way out; "" twice if one does."""
    if not dyn.scene.contact_pairs or dyn._joint_space is not None or is_generated(dyn):
        return "", ""
    obstacle = find_obstacle(dyn.scene, dyn.variable)
    return (obstacle, way_out(obstacle)) if obstacle else (NO_ROOM, NO_ROOM_WAY)


def reason_against_gradients(scene: Scene, variable: tuple[str, ...]) -> str:
    """Return why steps of a scene whose bodies touch have no gradients; "" if they have."""
    if scene.dof_count == 0:
        return "nothing can move"
    obstacle = find_obstacle(scene, variable)
    if obstacle:
        return f"{obstacle} have no solution in joint space"
    return "anchors vary" if {"joint_X_p", "joint_X_c"} & set(variable) else ""


def choose_slots(scene: Scene) -> tuple[int, int]:
    """Return how many pairs may be near in a world, and how many of their points get slots."""
    pairs = scene.contact_pairs
    bodies = {body for pair in pairs for body in (pair.body, pair.other) if body >= 0}
    points = sorted((_points(*pair.shapes) for pair in pairs), reverse=True)
    return min(len(pairs), max(NEAR, NEAR_A_BODY * len(bodies))), sum(points[: max(FULL, len(bodies))])


def _routine(one: ConvexShape, other: ConvexShape) -> int:
    """Return the number of the routine that finds the points of two shapes."""
    return convex_pairs.routine(*(convex_shapes.KINDS.index(_pair_shape(shape).kind) for shape in (one, other)))


def _points(one: ConvexShape, other: ConvexShape) -> int:
    """Return how many points two shapes share at most."""
    round_ones = [shape.kind == SWEPT_SEGMENT and shape.size[2] == 0.0 for shape in (one, other)]
    if any(round_ones):
        return 1
    return convex_pairs.POINTS if one.kind == other.kind == BOX else 4


class JointSpaceStep:
    """Steps of a Dynamics whose scene has pairs of bodies.

    Args:
        dyn: of the scene.
        near: pairs of shapes at most that are near each other in a world. slots: points of these at most. None: as
            :func:`choose_slots` says.
        lanes: threads of a world on a GPU: 8, 16 or 32; None: by the number of worlds.
        registers: of a thread at most; None: as the compiler chooses.
        margin: how near shapes must be to be looked at where nothing moves [m].
        refine: steps of iterative refinement in the last pass; None: one in float32.
        few: points of pairs up to which a world has a kernel with no more slots; None: as A_TREE says.
    """

    def __init__(
        self,
        dyn: Dynamics,
        near: int | None = None,
        slots: int | None = None,
        lanes: int | None = None,
        registers: int | None = None,
        margin: float = MARGIN,
        refine: int | None = None,
        few: int | None = None,
    ):
        scene: Scene = dyn.scene
        T: Any = dyn.dtype
        self.dyn = dyn
        self.margin, self.device, self.worlds = margin, dyn.device, dyn.worlds
        chosen = choose_slots(scene)
        self.near_count = near = chosen[0] if near is None else near
        self.slot_count = slots = chosen[1] if slots is None else slots
        pattern = dyn.mass_matrix_pattern
        surfaces, pairs = surface_numbers(scene, HEIGHTS in dyn.variable), scene.contact_pairs
        self.motor_laws = motors = motor_laws(scene, dyn.variable)
        tables = joint_tables(scene, pattern, near, slots, surfaces, motors, [_routine(*x.shapes) for x in pairs])
        sizes = tables.sizes
        least = min(slots, max(LEAST, LEAST_A_BODY * len(scene.bodies)))
        while self.device.is_cuda and slots > least and joint_space.world_bytes(sizes, T) > ROOM:
            self.slot_count = slots = max(least, slots - 8)
            sizes = sizes._replace(slots=slots + sizes.surfaces)
        if few is None:
            few = A_TREE * sum(parent < 0 for parent in scene.tree.parent) if self.device.is_cuda else slots
        few = min(few, slots) + sizes.surfaces
        parts = [sizes._replace(slots=few, leaves=True), sizes._replace(least=few)] if few < sizes.slots else [sizes]
        self.tables = tables = tables._replace(sizes=sizes)
        crowded = 2 * joint_space.world_bytes(parts[0], T) > MOST_SHARED
        narrow = (8 if scene.dof_count <= NARROW else 16) * (2 if dyn.worlds <= FEW else 1)
        self.lanes = lanes or (32 if crowded or scene.dof_count > WIDE else narrow)
        array: Any = functools.partial(wp.array, dtype=T, device=self.device)
        make = lambda *shape, dtype=T: wp.zeros(shape, dtype=dtype, device=self.device)  # noqa: E731
        varies = any(self._varies(name) for name in (*joint_system.LAWS.values(), *joint_system.OTHERS))
        rows = self.worlds if varies else 1
        self.names = (joint_space.DOF_VALUES, joint_space.PAIR_VALUES) if varies else None
        self.place = array(tables.place, dtype=int)
        self.dof_values, self.pair_values = (
            array(np.tile(values, (rows, 1))) for values in (tables.dof_values, tables.pair_values)
        )
        self.near = make(self.worlds * (1 + 2 * near), dtype=int)
        self.touches = make(self.worlds, near * joint_space.MOST * joint_space.POINT)
        self.surfaces = make(self.worlds, max(1, sizes.surfaces * joint_space.SURFACE))
        self.screws = make(self.worlds, scene.dof_count * joint_space.SCREW)
        self.motors = make(self.worlds, max(1, sizes.laws * joint_space.LAW))
        n, contacts = scene.dof_count, scene.contact_count
        self.neutral = array(np.tile(scene.neutral_q, (self.worlds, 1)))
        self.mass, self.poses = make(self.worlds, len(pattern[0])), make(self.worlds, scene.body_count, 7)
        self.velocities = make(self.worlds, scene.body_count, 6)
        self.bias, self.still = make(self.worlds, n), make(self.worlds, n)
        self.qd_out, self.qdd, self.excess = make(self.worlds, n), make(self.worlds, n), make(self.worlds, 3)
        self.contact_f, self.status = make(self.worlds, contacts, 3), make(self.worlds, dtype=int)
        self.contact_gap, self.contact_slip = make(self.worlds, contacts), make(self.worlds, contacts)
        gravity = float(np.linalg.norm(scene.values["gravity"], axis=1).max())
        self.gravity = gravity
        efforts = scene.values["joint_effort_limit"]
        weight = float(scene.values["body_mass"].sum(axis=1).max()) * 9.81
        effort = float(efforts[efforts > 0.0].min()) if (efforts > 0.0).any() else 1.0
        self.tolerances = [TOLERANCE * weight, TOLERANCE * effort]
        self.solvers = []
        for part, threads in zip(parts, (self.lanes, 32), strict=False):
            refined = int(T is wp.float32) if refine is None else refine
            kernel = joint_space.solver(part, T, threads, registers, refined)
            self.solvers.append((kernel, threads, joint_space.threads_of_block(part, T, threads)))
        self._make_shapes(array)
        self.broad = near_pairs.broad(sizes.pairs, near, T)

    def _varies(self, name: str) -> bool:
        values = self.dyn.scene.values[name]
        return name in self.dyn.variable or bool((values != values[:1]).any())

    def _make_shapes(self, array: Any) -> None:
        """Make what the phases read of the shapes of the pairs."""
        scene, T = self.dyn.scene, cast(Any, self.dyn.dtype)
        pairs = [scene.contact_pairs[i] for i in self.tables.pairs]
        numbers: dict[int, int] = {}
        shapes: list[PairShape] = []
        sides, which = [], []
        for pair in pairs:
            for shape in pair.shapes:
                if id(shape) not in numbers:
                    numbers[id(shape)] = len(shapes)
                    shapes.append(_pair_shape(shape))
        rows = shape_rows("Dynamics.step", shapes)
        for pair in pairs:
            for body, shape in zip((pair.body, pair.other), pair.shapes, strict=True):
                row = numbers[id(shape)]
                at = shape.pose[:3] + rotate(shape.pose[3:], rows.middles[row])
                sizes = shape.size + shape.radius
                ball = float(np.linalg.norm(shape.size)) + shape.radius
                if shape.hull is not None:
                    corners = shape.hull.corners - rows.middles[row]
                    sizes, ball = np.abs(corners).max(axis=0), float(np.linalg.norm(corners, axis=1).max())
                com = scene.values["body_com"][0, body] if body >= 0 else at
                which.append([body, row])
                sides.append([*at, *shape.pose[3:], *sizes, *com, float(np.linalg.norm(at - com)) + ball, ball])
        assert not sides or len(sides[0]) == len(near_pairs.SIDE)
        self.which, self.sides = array(np.ravel(which), dtype=int), array(np.ravel(sides))
        self.routines = rows.routines([which[i][1::2] + which[i + 1][1::2] for i in range(0, len(which), 2)])
        kinds = [array(np.ravel(rows.rows), dtype=int), array(rows.sizes)]
        kinds += [array(np.ravel(each)) for each in (rows.corners, rows.planes)]
        self.shapes = kinds + [array(each, dtype=int) for each in (rows.starts, rows.loops)]
        kernels = near_pairs.narrow, near_pairs.passing
        self.narrow, self.passing = (
            each(self.tables.sizes.pairs, self.near_count, T, self.routines) for each in kernels
        )

    def _launch(self, kernel: Any, threads: int, inputs: list, outputs: list, block: int = 64) -> None:
        launches.launch(kernel, threads, [self.worlds, *inputs], outputs, device=self.device, block_dim=block)

    def find_points(self, dt: float) -> None:
        """Find near pairs and their points, from ``poses`` and ``velocities``."""
        a_world = near_pairs.LANES if self.device.is_cuda else 1
        slack = self.margin + self.gravity * dt * dt
        shapes = [self.poses, self.velocities, self.which, self.sides, slack, dt]
        self._launch(self.broad, a_world * self.worlds, shapes, [self.near], 128)
        threads = self.near_count * self.worlds
        given = [*shapes, *self.shapes, self.near]
        self._launch(self.narrow, threads, given, [self.touches])
        self._launch(self.passing, threads, [0.5 * self.gravity * dt * dt, *given], [self.touches])

    def solve(
        self,
        q: wp.array,
        qd: wp.array,
        tau: wp.array | None,
        targets: tuple[wp.array | None, wp.array | None],
        dt: float,
        passes: int = PASSES,
        results: dict[str, wp.array] | None = None,
    ) -> None:
        """Compute the rates that the passes find, ``qd_out``, and reports from mass, bias, surfaces, poses, and points.

        ``results``: arrays in place of ``qdd``, ``contact_f`` and further attributes, by name.
        """
        tau, (target_q, target_qd) = self.still if tau is None else tau, targets
        system = [self.mass, self.bias, tau, q, qd, self.neutral if target_q is None else target_q]
        system += [self.still if target_qd is None else target_qd, self.screws, self.near, self.touches, self.surfaces]
        system += [self.motors, self.dof_values, self.pair_values, self.place]
        names = "qd_out", "qdd", "contact_f", "contact_gap", "contact_slip", "excess", "status"
        out = [(results or {}).get(name, getattr(self, name)) for name in names]
        numbers = [dt, float(passes), *self.tolerances]
        for kernel, lanes, block in self.solvers:
            a_world = lanes if self.device.is_cuda else 1
            self._launch(kernel, a_world * self.worlds, system + numbers, out, block)

    def find_system(self, q: wp.array, qd: wp.array, dt: float, **acting: wp.array | None) -> None:
        """Compute mass, poses, velocities, bias, surfaces, and what varies between worlds, of a state.

        ``acting``: body_f; ctrl, target_q and target_qd of motors.
        """
        engine, sizes, more = self.dyn._engine, self.tables.sizes, dict[str, wp.array]()
        engine.launch(MASS_MATRIX_PACKED, self.mass, q=q)
        states = {joint_system.VELOCITIES: self.velocities, joint_system.SCREWS: self.screws}
        engine.launch_routine(STATES, self.poses, states, q=q, qd=qd)
        more |= {joint_system.SURFACES: self.surfaces} if sizes.surfaces else {}
        if self.names is not None:
            more |= {joint_system.OF_DOFS: self.dof_values, joint_system.OF_PAIRS: self.pair_values}
        if sizes.laws:
            more |= {joint_system.OF_MOTORS: self.motors}
        else:
            acting = {name: array for name, array in acting.items() if name == "body_f"}
        if not more:
            given: dict[str, Any] = acting
            engine.launch_routine(BIAS, self.bias, q=q, qd=qd, **given)
            return
        options: dict[str, Any] = dict(pairs=tuple(self.tables.pairs), motors=self.motor_laws, names=self.names)
        options["surfaces"] = bool(sizes.surfaces)
        engine.launch_routine(SYSTEM, self.bias, more, q=q, qd=qd, dt=dt, **acting, **options)

    def step(
        self,
        q: wp.array,
        qd: wp.array,
        tau: wp.array | None,
        targets: tuple[wp.array | None, wp.array | None],
        dt: float,
        passes: int = PASSES,
        after: tuple[wp.array, wp.array] | None = None,
        body_f: wp.array | None = None,
        ctrl: wp.array | None = None,
        results: dict[str, wp.array] | None = None,
    ) -> wp.array:
        """Return the rates that the passes find.

        ``targets``: q and qd of the drives, None is the neutral. ``after``: arrays for q and qd after the step.
        """
        self.find_system(q, qd, dt, body_f=body_f, ctrl=ctrl, target_q=targets[0], target_qd=targets[1])
        self.find_points(dt)
        self.solve(q, qd, tau, targets, dt, passes, results)
        if after is not None:
            passed = {joint_system.PASSED: self.qd_out}
            self.dyn._engine.launch_routine(STATE_AFTER, after[1], {"q_out": after[0]}, q=q, qd=qd, dt=dt, **passed)
        return self.qd_out

    def launch(
        self,
        q: wp.array,
        qd: wp.array,
        after: tuple[wp.array, wp.array],
        dt: float,
        passes: int,
        reports: dict[str, wp.array],
        tau: wp.array | None = None,
        target_q: wp.array | None = None,
        target_qd: wp.array | None = None,
        body_f: wp.array | None = None,
        ctrl: wp.array | None = None,
    ) -> None:
        """Launch the step of :meth:`Dynamics.step`; ``after``: arrays for q and qd, ``reports``: others by name."""
        if "contact_moment" in reports:
            launches.fill(reports["contact_moment"], 0)
        renamed = {"contact_excess": "excess"}
        results = {renamed.get(name, name): array for name, array in reports.items()}
        self.step(q, qd, tau, (target_q, target_qd), dt, passes, after, body_f, ctrl, results)

    @property
    def fits(self) -> bool:
        """Whether a world fits into the shared memory of a block."""
        return not self.device.is_cuda or joint_space.world_bytes(self.tables.sizes, self.dyn.dtype) <= ROOM

    def explain(self) -> str:
        """Return in words how pairs are solved."""
        threads = f", {self.lanes} threads a world" if self.device.is_cuda else ""
        return (
            f"pairs of bodies in joint space{threads}: {self.near_count} of {self.tables.sizes.pairs} pairs may be near"
            f" each other in a world, and {self.slot_count} points of them have slots"
        )


def _pair_shape(shape: ConvexShape) -> PairShape:
    """Return a shape of a pair as the narrow phase takes it."""
    if shape.hull is not None:
        return PairShape("hull", shape.hull.corners)
    if shape.has_faces:
        return PairShape("box", shape.size)
    if shape.kind == ELLIPSOID:
        return PairShape("ellipsoid", shape.size, shape.radius)
    if shape.kind == CYLINDER:
        return PairShape("cylinder", (shape.size[0], shape.size[2]), shape.radius)
    radius, half = max(shape.radius, TINY), float(shape.size[2])
    return PairShape("capsule", (radius, half)) if half > 0.0 else PairShape("sphere", (radius,))
