"""A step of a scene whose bodies touch, solved in joint space by :mod:`warp_spo.kernels.joint_space`."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...kernels import joint_space, near_pairs
from ...recursions.contact.joint_tables import joint_tables
from ...recursions.contact.pairs import PASSES
from ...runtime import launches

if TYPE_CHECKING:
    from ...scene.scene import Scene
    from ..dynamics import Dynamics

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
        self.lanes = lanes or (32 if dyn.worlds <= 8192 else 16)
        pattern = dyn.mass_matrix_pattern
        self.tables = tables = joint_tables(scene, pattern, near, slots)
        sizes = tables.sizes
        array: Any = functools.partial(wp.array, dtype=T, device=self.device)
        self.place, self.which = array(tables.place, dtype=int), array(tables.which, dtype=int)
        self.dof_values, self.pair_values = array(tables.dof_values), array(tables.pair_values)
        self.sides = array(tables.sides)
        make = lambda *shape, dtype=T: wp.zeros(shape, dtype=dtype, device=self.device)  # noqa: E731
        self.near = make(self.worlds * (1 + 2 * near), dtype=int)
        self.touches = make(self.worlds, near * joint_space.MOST * joint_space.POINT)
        n = scene.dof_count
        self.mass, self.poses = make(self.worlds, len(pattern[0])), make(self.worlds, scene.body_count, 7)
        self.bias, self.still = make(self.worlds, n), make(self.worlds, n)
        self.qd_out, self.excess = make(self.worlds, n), make(self.worlds, 3)
        self.contact_f, self.status = make(self.worlds, scene.contact_count, 3), make(self.worlds, dtype=int)
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
        out = [self.qd_out, self.contact_f, self.excess, self.status]
        a_world = self.lanes if self.device.is_cuda else 1
        numbers = [dt, float(passes), self.half_gravity, self.margin]
        self._launch(self.solver, a_world * self.worlds, system + numbers, out, joint_space.BLOCK)

    def find_system(self, q: wp.array, qd: wp.array) -> None:
        """Compute mass, poses and bias of a state."""
        self.dyn.mass_matrix_packed(q, out=self.mass)
        self.dyn.body_poses(q, out=self.poses)
        self.dyn.bias_force(q, qd, self.lift, out=self.bias)

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
            self.dyn.integrate(q, self.qd_out, dt, out=q_out)
        return self.qd_out
