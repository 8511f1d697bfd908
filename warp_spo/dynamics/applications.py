"""The paper's applications beyond dynamics and kinematics: methods of :class:`warp_spo.Dynamics`.

Hybrid dynamics, operational space, momentum, the determinant of the mass matrix and quasi-velocities. But for
operational_inertia each is one kernel that is compiled for the scene, a thread a world, whatever the granularity.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..arrays import Call, broadcast_worlds, shape_of
from ..errors import refuse_masked
from ..execution.programs import Programs
from ..execution.sweeps import Sweeps
from ..kernels import cholesky
from ..scene.frames import Frame, check_frames
from ..scene.scene import Scene


class Applications:
    """What Dynamics inherits. Arrays and coordinates are as there."""

    scene: Scene
    worlds: int
    device: wp.Device
    dtype: type
    recursions: Sweeps
    programs: Programs
    _minimal: int  # independent dofs

    # -- prescribed motion -----------------------------------------------------------------------------------------
    def hybrid_dynamics(
        self,
        q: Any,
        qd: Any = None,
        tau: Any = None,
        qdd: Any = None,
        *,
        prescribed: Any,
        body_f: Any = None,
        out: Any = (None, None),
    ) -> tuple[Any, Any]:
        """Forward dynamics of some dofs, inverse dynamics of the others: Mass qdd + bias_force = tau.

        Dofs under the mask follow ``qdd``, whatever it takes; the others move under ``tau``. All prescribed is inverse
        dynamics, none is forward dynamics. A prescribed dof is not eliminated from the articulated inertia: P+ = P,
        z+ = z + P H* qdd, and its force is H f + Delta qdd. Featherstone, Rigid Body Dynamics Algorithms, 9.2.

        Args:
            q, qd, body_f: as :meth:`forward_dynamics`.
            tau: forces of the dofs that are not prescribed [world, dof]; other entries are not looked at; None is zero.
            qdd: accelerations of the prescribed dofs [world, dof], likewise; None is zero.
            prescribed: bool. A list or NumPy array [dof] folds into the kernel, of which each mask then has its own.
                Arrays on the device, [world, dof] or [dof], and NumPy arrays [world, dof] are read at each call.
            out: (qdd, tau), each an array or None.

        Returns:
            qdd, tau [world, dof]: all of them, the given ones as they were given. A world whose free dofs have no
            positive definite mass matrix is NaN.

        With loops embedded, dofs under the mask are among the independent ones, and the mask folds; their tau is what
        is needed beside the tau of all other dofs.
        """
        shape = (self.worlds, self.scene.dof_count)
        with self._call("hybrid_dynamics") as call:
            if not isinstance(out, tuple | list) or len(out) != 2:
                raise TypeError(f"{call.name}: out is {out!r}; expected a pair of arrays or None, (qdd, tau)")
            q, qd = self._read_state(call, q, qd)
            tau, qdd = self._read_rate(call, "tau", tau), self._read_rate(call, "qdd", qdd)
            body_f = self._read_body_f(call, body_f)
            mask, held = self._read_mask(call, prescribed)
            self._check_prescribed(call, held)
            qdd_out = call.write(out[0], shape, "[world, dof]", name="out[0]")
            tau_out = call.write(out[1], shape, "[world, dof]", name="out[1]")
            given = dict(q=q, qd=qd, tau=tau, qdd=qdd, body_f=body_f, prescribed=mask, held=held)
            self._launch("hybrid_dynamics", qdd_out, {"tau_out": tau_out}, **given)
        return call.result

    def _read_mask(self, call: Call, mask: Any) -> tuple[Any, Any]:
        """The mask as an array [world, dof], or as a tuple of bools that folds."""
        dofs = self.scene.dof_count
        if isinstance(mask, list | tuple):
            try:
                mask = np.asarray(mask, dtype=bool if len(mask) == 0 else None)
            except ValueError:
                raise ValueError(f"{call.name}: prescribed is {mask!r}; expected bools, one for each dof") from None
        refuse_masked(call.name, "prescribed", mask)
        if isinstance(mask, np.ndarray) and mask.ndim == 1:
            if mask.shape != (dofs,) or mask.dtype != bool:
                raise ValueError(
                    f"{call.name}: prescribed is {mask.dtype} {mask.shape}; expected bool ({dofs},) [dof] or "
                    f"({self.worlds}, {dofs}) [world, dof]"
                )
            return None, tuple(mask.tolist())
        if not hasattr(mask, "shape") or len(shape_of(mask)) != 1:
            return call.read("prescribed", mask, (self.worlds, dofs), "[world, dof] or [dof]", dtype=wp.bool), None
        shared = call.read("prescribed", mask, (dofs,), "[world, dof] or [dof]", dtype=wp.bool)
        if shared.size:
            wp.copy(self._mask, broadcast_worlds(shared.reshape((1, dofs)), 0, self.worlds))
        return self._mask, None

    @functools.cached_property
    def _mask(self) -> wp.array:
        return wp.empty((self.worlds, self.scene.dof_count), dtype=wp.bool, device=self.device)

    # -- operational space -----------------------------------------------------------------------------------------
    def operational_inertia(self, q: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """Inertia that the frames feel: (J Mass^-1 J*)^-1, J of :meth:`jacobian`, by Cholesky.

        Rows and columns: linear [kg], then angular [kg m^2], frame after frame, inertial axes. Khatib 1987; Jain 2011,
        ch. 10. With loops embedded they are part of what the frames feel.

        Returns:
            [world, 6 frames, 6 frames], both triangles. NaN in worlds where J Mass^-1 J* is singular to working
            precision: in all of them if the dofs above the frames cannot move all of their 6 rows independently.
        """
        with self._call("operational_inertia") as call:
            q, _ = self._read_state(call, q, None)
            where = check_frames(self.scene, call.name, frames)
            rows = 6 * len(where)
            out = call.write(out, (self.worlds, rows, rows), "[world, 6 frames, 6 frames]")
            mobility = self.recursions.array(("operational_inertia_inverse", rows), self.worlds, rows, rows)
            size = self.recursions.array(("operational_inertia size", rows), self.worlds, rows)
            self._run("operational_inertia_inverse", mobility, q=q, frames=where)
            self.recursions.launch(cholesky.inverse, self.worlds, [mobility], [size, out])
        return call.result

    def jacobian_bias(self, q: Any, qd: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """J' qd: what the frames accelerate at qdd = 0, so that J qdd + J' qd is their acceleration.

        Acceleration of each frame's origin [m/s^2], then angular acceleration [rad/s^2], inertial axes: the time
        derivative of the rows of :meth:`jacobian` times qd. Gravity is not in it. With loops embedded at qdd = 0 of the
        independent dofs, what the velocities demand of the others included.

        Returns:
            [world, frame, 6]
        """
        with self._call("jacobian_bias") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            where = check_frames(self.scene, call.name, frames)
            out = call.write(out, (self.worlds, len(where), 6), "[world, frame, 6]")
            self._launch("jacobian_bias", out, q=q, qd=qd, frames=where)
        return call.result

    def frame_accelerations(self, q: Any, qd: Any, qdd: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """J qdd + J' qd: how the frames accelerate, in one outward sweep; with forward_dynamics, task-space dynamics.

        Acceleration of each frame's origin [m/s^2], then angular acceleration [rad/s^2], inertial axes. Gravity is not
        in it. qd and qdd None are zero. They are of all dofs whatever ties them, as forward_dynamics gives them.

        Returns:
            [world, frame, 6]
        """
        with self._call("frame_accelerations") as call:
            q, qd = self._read_state(call, q, qd)
            qdd = self._read_rate(call, "qdd", qdd)
            where = check_frames(self.scene, call.name, frames)
            out = call.write(out, (self.worlds, len(where), 6), "[world, frame, 6]")
            self._launch("frame_accelerations", out, q=q, qd=qd, qdd=qdd, frames=where)
        return call.result

    def operational_inertia_inverse_product(self, q: Any, x: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """J Mass^-1 J* x in O(dof), nothing formed: what wrenches x on the frames make these accelerate.

        With loops embedded they hold, as in :meth:`operational_inertia`.

        Args:
            q: coordinates [world, coordinate].
            x: force, then torque on each frame, at its origin, inertial axes [world, 6 frames].
            frames: as :meth:`jacobian`.

        Returns:
            [world, frame, 6], laid out as :meth:`frame_accelerations`. NaN where Mass has no inverse.
        """
        with self._call("operational_inertia_inverse_product") as call:
            q, _ = self._read_state(call, q, None)
            where = check_frames(self.scene, call.name, frames)
            x = call.read("x", x, (self.worlds, 6 * len(where)), "[world, 6 frames]")
            out = call.write(out, (self.worlds, len(where), 6), "[world, frame, 6]")
            self._launch("operational_inertia_inverse_product", out, q=q, x=x, frames=where)
        return call.result

    # -- momentum --------------------------------------------------------------------------------------------------
    def com_jacobian(self, q: Any, out: Any = None) -> Any:
        """Velocity of the centre of mass per unit qd, inertial axes: sum of m(k) J(k) / sum of m(k).

        The centre of mass is that of all bodies that a hinge lets move, of every tree of the scene together. With loops
        embedded per unit qd of the independent dofs.

        Returns:
            [world, 3, dof], [m/s per unit qd]
        """
        return self._of_q("com_jacobian", q, (3, self._minimal), "[world, 3, dof]", out)

    def centroidal_momentum_matrix(self, q: Any, out: Any = None) -> Any:
        """Momentum per unit qd: linear [kg m/s], then angular about the centre of mass [kg m^2/s], inertial axes.

        The order is that of :meth:`jacobian`: linear first. The centre of mass is that of :meth:`com_jacobian`;
        armature is not in it. A column is R(k) H*, R(k) the composite inertia, seen from the centre of mass. With loops
        embedded A X, of the independent dofs. Orin, Goswami, Lee 2013.

        Returns:
            A [world, 6, dof]
        """
        return self._of_q("centroidal_momentum_matrix", q, (6, self._minimal), "[world, 6, dof]", out)

    def centroidal_momentum_bias(self, q: Any, qd: Any, out: Any = None) -> Any:
        """A' qd for A of :meth:`centroidal_momentum_matrix`: A qdd + A' qd is the rate of the momentum.

        Returns:
            [world, 6]: force [N], then moment about the centre of mass [N m], inertial axes.
        """
        with self._call("centroidal_momentum_bias") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            out = call.write(out, (self.worlds, 6), "[world, 6]")
            self._launch("centroidal_momentum_bias", out, q=q, qd=qd)
        return call.result

    # -- the mass matrix' other faces ------------------------------------------------------------------------------
    def quasi_velocities(self, q: Any, qd: Any, out: Any = None) -> Any:
        """nu = sqrt(D) [I + H phi K]* qd, in which the kinetic energy is nu . nu / 2 (armature included).

        [I + H phi K] is taken dof by dof, later dofs of a hinge eliminated first: the unit upper triangular factor U of
        Mass = U D U* where dofs nearer to the root come first. Jain, Rodriguez 1995, "Diagonalized Lagrangian robot
        dynamics".

        Returns:
            [world, dof], [sqrt(kg) m/s]; NaN where D is not positive.
        """
        with self._call("quasi_velocities") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            out = call.write(out, (self.worlds, self.scene.dof_count), "[world, dof]")
            self._launch("quasi_velocities", out, q=q, qd=qd)
        return call.result

    def log_det_mass_matrix_gradient(self, q: Any, out: Any = None) -> Any:
        """Gradient of log det Mass: its rate is gradient . qd; one sweep in and one out, O(dof).

        Dual to qd, like a force: the entry of a dof is the derivative along unit qd of that dof alone. It is
        2 tr(Upsilon+ crf(H*) P+), Upsilon the gradient by the articulated inertia. A. Jain 1997.

        Returns:
            [world, dof], [1 per unit of the dof]
        """
        return self._of_q("log_det_mass_matrix_gradient", q, (self.scene.dof_count,), "[world, dof]", out)

    def fixman_torque(self, q: Any, out: Any = None) -> Any:
        """Force of the Fixman potential (kT/2) log det Mass, divided by kT: -1/2 the gradient of log det Mass.

        Times kT it takes out the bias that rigid bonds put on the distribution of q. Fixman 1974; A. Jain 1997.

        Returns:
            [world, dof], [1 per unit of the dof], dual to qd.
        """
        return self._of_q("fixman_torque", q, (self.scene.dof_count,), "[world, dof]", out)

    def mass_matrix_packed(self, q: Any, out: Any = None) -> Any:
        """Entries of :meth:`mass_matrix` that the tree allows, those of :attr:`mass_matrix_pattern` [world, entry]."""
        return self._of_q("mass_matrix_packed", q, (len(self.mass_matrix_pattern[0]),), "[world, entry]", out)

    @functools.cached_property
    def mass_matrix_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the entries of Mass's lower triangle that the tree allows, row after row.

        Two dofs meet if one's body carries the other's, or if they are of one hinge.
        """
        self._check_operation("mass_matrix_packed")
        scene, met = self.scene, []
        node_of = np.repeat(np.argsort(scene.hinge_of), np.diff(scene.qd_start))
        for row, a in enumerate(node_of):
            for column, b in enumerate(node_of[: row + 1]):
                if a == b or scene.tree.is_ancestor(int(a), int(b)) or scene.tree.is_ancestor(int(b), int(a)):
                    met.append((row, column))
        rows, columns = np.array(met, dtype=int).reshape(-1, 2).T
        return rows, columns

    def mass_matrix_inverse_packed(self, q: Any, out: Any = None) -> Any:
        """Entries of :meth:`mass_matrix_inverse` at :attr:`mass_matrix_inverse_pattern` [world, entry].

        Worlds where Mass is not positive definite are NaN as there.
        """
        shape = self.mass_matrix_inverse_pattern[0].shape
        return self._of_q("mass_matrix_inverse_packed", q, shape, "[world, entry]", out)

    @functools.cached_property
    def mass_matrix_inverse_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the entries of Mass^-1's lower triangle that are not zero, row after row.

        Two dofs meet if one moving body carries both. Within one tree nothing is zero; trees of a forest do not meet.
        """
        self._check_operation("mass_matrix_inverse_packed")
        scene, carrier = self.scene, np.full(self.scene.body_count, -1)
        for node in (node for level in scene.tree.levels for node in level):
            above = carrier[scene.tree.parent[node]] if scene.tree.parent[node] >= 0 else -1
            carrier[node] = above if above >= 0 or scene.hinge_sizes[node] == 0 else node
        root = np.repeat(carrier[np.argsort(scene.hinge_of)], np.diff(scene.qd_start))
        rows, columns = np.nonzero(np.tril(root[:, None] == root[None]))
        return rows, columns

    # -- steps -----------------------------------------------------------------------------------------------------
    def _of_q(self, name: str, q: Any, shape: tuple[int, ...], meaning: str, out: Any) -> Any:
        with self._call(name) as call:
            q, _ = self._read_state(call, q, None)
            out = call.write(out, (self.worlds, *shape), meaning)
            self._launch(name, out, q=q)
        return call.result

    def _launch(self, operation: str, out: wp.array, more: dict[str, wp.array] | None = None, **given: Any) -> None:
        """Launch an operation that has no node form; None is not given, what is no array and no float is an option."""
        if out.size == 0:
            return
        if self.scene.dof_count == 0:
            out.zero_()
            return
        more = more or {}
        arrays = {name: value for name, value in given.items() if isinstance(value, wp.array | float)}
        options = {name: value for name, value in given.items() if value is not None and name not in arrays}
        shapes = {name: getattr(array, "shape", ()) for name, array in arrays.items()}
        further = {name: array.shape for name, array in more.items()}
        program = self.programs.find(operation, shapes, out.shape, further, **options)
        self.programs.launch(program, arrays, out, *more.values())

    _check_operation: Any
    _check_prescribed: Any
    _call: Any
    _read_state: Any
    _read_rate: Any
    _read_body_f: Any
    _run: Any
