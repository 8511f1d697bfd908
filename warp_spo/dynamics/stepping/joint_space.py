"""A step of a scene whose bodies touch, solved in joint space by :mod:`warp_spo.kernels.joint_space`."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...errors import UnsupportedError
from ...execution.joint_tables import joint_tables
from ...execution.routine import Routine
from ...kernels import joint_space, near_pairs
from ...recursions import coordinates
from ...recursions.contact.pairs import PASSES
from ...runtime import launches
from ..inertia import MASS_MATRIX_PACKED
from ..inverse_dynamics import BIAS_FORCE
from ..kinematics import BODY_POSES

if TYPE_CHECKING:
    from ...scene.scene import Scene
    from ..dynamics import Dynamics

INTEGRATE = Routine("integrate", coordinates.integrate)
FEW, MOST_SHARED = 8192, 96 * 1024
"""Worlds up to which each takes a warp; shared memory of a block above which it does, too [bytes]. Not measured yet."""
MARGIN = 5e-3  # how near shapes and points must be to be looked at [m]


class JointSpaceStep:
    """Steps of a Dynamics whose scene has pairs of bodies, and no contact with the ground.

    Args:
        dyn: of the scene; its worlds share the scene's values.
        near: pairs of shapes at most that are near each other in a world. slots: points at most.
        lanes: threads of a world on a GPU: 8, 16 or 32; None: by the number of worlds.
        registers: of a thread at most; None: as the compiler chooses.
        margin: how near shapes and points must be to be looked at [m].
        refine: steps of iterative refinement in the last pass; None: one in float32.
    """

    def __init__(
        self,
        dyn: Dynamics,
        near: int = 16,
        slots: int = 32,
        lanes: int | None = None,
        registers: int | None = None,
        margin: float = MARGIN,
        refine: int | None = None,
    ):
        scene: Scene = dyn.scene
        T: Any = dyn.dtype
        self.dyn = dyn
        self.near_count, self.margin, self.device, self.worlds = near, margin, dyn.device, dyn.worlds
        pattern = dyn.mass_matrix_pattern
        self.tables = tables = joint_tables(scene, pattern, near, slots)
        sizes = tables.sizes
        crowded = 2 * joint_space.world_bytes(sizes, T) > MOST_SHARED
        self.lanes = lanes or (32 if crowded or dyn.worlds <= FEW else 16)
        array: Any = functools.partial(wp.array, dtype=T, device=self.device)
        self.place, self.which = array(tables.place, dtype=int), array(tables.which, dtype=int)
        self.dof_values, self.pair_values = array(tables.dof_values), array(tables.pair_values)
        self.sides = array(tables.sides)
        make = lambda *shape, dtype=T: wp.zeros(shape, dtype=dtype, device=self.device)  # noqa: E731
        self.near = make(self.worlds * (1 + 2 * near), dtype=int)
        self.touches = make(self.worlds, near * joint_space.MOST * joint_space.POINT)
        n = scene.dof_count
        self.neutral = array(np.tile(scene.neutral_q, (self.worlds, 1)))
        self.mass, self.poses = make(self.worlds, len(pattern[0])), make(self.worlds, scene.body_count, 7)
        self.bias, self.still = make(self.worlds, n), make(self.worlds, n)
        self.qd_out, self.excess = make(self.worlds, n), make(self.worlds, 3)
        self.contact_f, self.status = make(self.worlds, scene.contact_count, 3), make(self.worlds, dtype=int)
        self.contact_gap, self.contact_slip = (make(self.worlds, scene.contact_count) for _ in range(2))
        lift, mass = scene.values["body_gravcomp"][0], scene.values["body_mass"][0]
        gravity = scene.values["gravity"][0]
        self.lift: wp.array | None = None
        if lift.any():
            push = np.zeros((self.worlds, scene.body_count, 6))
            push[..., :3] = -(lift * mass)[:, None] * gravity
            self.lift = array(push)
        self.half_gravity = 0.5 * float(np.linalg.norm(gravity))
        self.solver = joint_space.solver(
            sizes, T, self.lanes, registers, int(T is wp.float32) if refine is None else refine
        )
        self.broad = near_pairs.broad(sizes.pairs, near, T)
        self.narrow = near_pairs.narrow(sizes.pairs, near, T, tables.hulls, tables.long, tables.faces)

    def _launch(self, kernel: Any, threads: int, inputs: list, outputs: list, block: int = 64) -> None:
        launches.launch(kernel, threads, [self.worlds, *inputs], outputs, device=self.device, block_dim=block)

    def find_points(self) -> None:
        """Find near pairs and their points, from ``poses``."""
        a_world = near_pairs.LANES if self.device.is_cuda else 1
        shapes = [self.poses, self.which, self.sides]
        self._launch(self.broad, a_world * self.worlds, [*shapes, self.margin], [self.near], 128)
        self._launch(self.narrow, self.near_count * self.worlds, [*shapes, self.near], [self.touches])

    def solve(
        self,
        q: wp.array,
        qd: wp.array,
        tau: wp.array | None,
        targets: tuple[wp.array, wp.array | None],
        dt: float,
        passes: int = PASSES,
    ) -> None:
        """Compute ``qd_out``, ``contact_f``, ``excess``, ``status`` from mass, bias, poses, and points."""
        tau, (target_q, target_qd) = self.still if tau is None else tau, targets
        system = [self.mass, self.bias, tau, q, qd, target_q, self.still if target_qd is None else target_qd]
        system += [self.poses, self.near, self.touches, self.dof_values, self.pair_values, self.place]
        out = [self.qd_out, self.contact_f, self.contact_gap, self.contact_slip, self.excess, self.status]
        a_world = self.lanes if self.device.is_cuda else 1
        numbers = [dt, float(passes), self.half_gravity, self.margin]
        self._launch(self.solver, a_world * self.worlds, system + numbers, out, joint_space.BLOCK)

    def find_system(self, q: wp.array, qd: wp.array) -> None:
        """Compute mass, poses and bias of a state."""
        launch = self.dyn._engine.launch
        launch(MASS_MATRIX_PACKED, self.mass, q=q)
        launch(BODY_POSES, self.poses, q=q)
        launch(BIAS_FORCE, self.bias, q=q, qd=qd, body_f=self.lift)

    def step(
        self,
        q: wp.array,
        qd: wp.array,
        tau: wp.array | None,
        targets: tuple[wp.array, wp.array | None],
        dt: float,
        passes: int = PASSES,
        q_out: wp.array | None = None,
    ) -> wp.array:
        """Return qd after the step; with ``q_out`` also q. ``targets``: q and qd of the drives, None is zero."""
        self.find_system(q, qd)
        self.find_points()
        self.solve(q, qd, tau, targets, dt, passes)
        if q_out is not None:
            self.dyn._engine.launch_routine(INTEGRATE, q_out, q=q, qd=self.qd_out, dt=dt)
        return self.qd_out

    def launch(
        self,
        q: wp.array,
        qd: wp.array,
        after: tuple[wp.array, wp.array],
        dt: float,
        passes: int,
        further: dict[str, wp.array],
        tau: wp.array | None = None,
        target_q: wp.array | None = None,
        target_qd: wp.array | None = None,
        **given: Any,
    ) -> None:
        """Launch the step of :meth:`Dynamics.step`; ``after``: arrays for q and qd, ``further``: others by name."""
        for name, value in given.items():
            if value is not None:
                raise UnsupportedError("Dynamics.step", f"{name}= where bodies touch in joint space", "leave it out")
        results = {"contact_f": self.contact_f, "contact_gap": self.contact_gap, "contact_slip": self.contact_slip,
                   "contact_excess": self.excess, "status": self.status}  # fmt: skip
        if lacks := [name for name in further if name not in results]:
            raise UnsupportedError("Dynamics.step", f"{lacks[0]} where bodies touch in joint space", "leave it out")
        aim = self.neutral if target_q is None else target_q
        self.find_system(q, qd)
        self.find_points()
        self.solve(q, qd, tau, (aim, target_qd), dt, passes)
        self.dyn._engine.launch_routine(INTEGRATE, after[0], q=q, qd=self.qd_out, dt=dt)
        launches.copy(after[1], self.qd_out)
        for name, array in further.items():
            launches.copy(array, results[name])
