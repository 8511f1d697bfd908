"""The inertia of SolverSPO's robots for Newton's actuators, operational-space controllers and coupled solvers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp
from newton import ModelFlags
from newton.solvers.experimental.coupled import CouplingInterface

from ..dynamics.dynamics import Dynamics
from ..errors import UnsupportedError
from ..scene.frames import Frame
from .layout import StateLayouts
from .tape import refuse_tape
from .worlds import to_numpy


class MassMatrixInterface(CouplingInterface):
    """Base class of SolverSPO with the methods by which other parts of Newton ask for its mass matrix."""

    model: newton.Model
    dynamics: Dynamics
    _layouts: StateLayouts
    _body_rows: np.ndarray  # the model's bodies [world, body]

    def solve_inverse(self, state: newton.State) -> Callable[[wp.array, wp.array], None]:
        """Return ``solve(x, y)``, which writes x = Mass^-1 y at ``state``, armature included.

        x and y are [world, dof] of the scene. The function is meant for ``newton.actuators.JointSpaceResponse``, which
        needs ``dof_map`` if loop joints have entries in joint_qd::

            response.refresh_from_solve(solver.solve_inverse(state), dof_map=solver.dof_map)
        """
        self._check_open("solve_inverse")
        refuse_tape("SolverSPO.solve_inverse", state)
        q = self._layouts.q.read(state.joint_q, "q")

        def solve(x: wp.array, y: wp.array) -> None:
            self.dynamics.solve_mass_matrix(q, y, out=x)

        return solve

    @property
    def dof_map(self) -> wp.array:
        """Entry of the model's joint_qd for each dof of the scene, int32 [world, dof]."""
        return wp.array(self.dynamics.scene.dof_index, dtype=wp.int32, device=self.model.device)

    def operational_space(self, state: newton.State, frame: Frame, inputs: Any) -> None:
        """Fill ``jacobian_tool_world``, ``mass_matrix`` and ``gravity_force`` of a controller's inputs.

        The method serves a ``newton.controllers.ControllerOperationalSpaceModelFree`` that controls every dof of every
        world, one robot a world. It only launches kernels.

        Args:
            state: The state at which they are computed.
            frame: The tool's frame: a body's index or label, or (body, pose in the body).
            inputs: The controller's inputs. A ``mass_matrix`` or ``gravity_force`` that is None stays None.
        """
        self._check_open("operational_space")
        refuse_tape("SolverSPO.operational_space", state)
        dyn, q = self.dynamics, self._layouts.q.read(state.joint_q, "q")
        worlds, dofs = dyn.worlds, dyn.scene.dof_count
        dyn.jacobian(q, [frame], out=inputs.jacobian_tool_world.reshape((worlds, 1, 6, dofs)))
        if inputs.mass_matrix is not None:
            dyn.mass_matrix(q, out=inputs.mass_matrix)
        if inputs.gravity_force is not None:
            dyn.gravity_force(q, out=inputs.gravity_force.reshape((worlds, dofs)))

    # -- coupling --------------------------------------------------------------------------------------------------
    def coupling_effective_mass_refresh_flags(self) -> int:
        """Return the flags of ``notify_model_changed`` that change effective masses."""
        flags = ModelFlags.BODY_INERTIAL_PROPERTIES | ModelFlags.JOINT_PROPERTIES | ModelFlags.JOINT_DOF_PROPERTIES
        return int(flags | ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES)

    def coupling_supports_inertial_property_refresh(self) -> bool:
        """Whether masses and inertias may change without rebuilding the solver."""
        return "body_mass" in self.dynamics.variable and "body_inertia" in self.dynamics.variable

    def coupling_eval_effective_mass(
        self, endpoint_kind: Any, endpoint_index: Any, endpoint_local_pos: Any, out: Any
    ) -> None:
        """Compute the masses of :meth:`coupling_eval_effective_mass_block` without the inertias."""
        self.coupling_eval_effective_mass_block(endpoint_kind, endpoint_index, endpoint_local_pos, out)

    def coupling_eval_effective_mass_block(
        self,
        endpoint_kind: Any,
        endpoint_index: Any,
        endpoint_local_pos: Any,
        out_mass: Any,
        out_inertia: Any = None,
    ) -> None:
        """Compute the effective mass and inertia of points of bodies at ``model.joint_q``, on the host.

        The mass [kg] is 3 / trace(J Mass^-1 J*) with the point's linear Jacobian J. A point that cannot move has mass
        0, as fixed bodies and particles have in Newton. The inertia [kg m^2], in the body's axes, is (J Mass^-1 J*)^-1
        with the body's angular Jacobian J. If the body cannot turn about all three axes it is the body's own inertia,
        which is a lower bound. The method reads back from the device, so it cannot run inside a graph capture.

        Args:
            endpoint_kind: Kinds of the endpoints, int [n]; only 0, a body, is supported.
            endpoint_index: The model's bodies, int [n].
            endpoint_local_pos: Points from the CoM in body axes [n, 3] [m].
            out_mass: Receives the masses [n].
            out_inertia: Receives the inertias [n, 3, 3], or None.

        Raises:
            ValueError: An endpoint is not a body.
        """
        self._check_open("coupling_eval_effective_mass_block")
        kinds, bodies = endpoint_kind.numpy(), endpoint_index.numpy()
        if kinds.any():
            raise ValueError(
                f"SolverSPO: a coupling endpoint of kind {kinds[kinds != 0][0]} is no body; expected kind 0 (BODY); "
                "couple a point of a body"
            )
        dyn, scene = self.dynamics, self.dynamics.scene
        q = self._layouts.q.read(self.model.joint_q, "coupled").numpy()
        frames = list(range(scene.body_count))
        J = dyn.jacobian(q, frames).astype(np.float64)
        poses, minv = dyn.body_poses(q), dyn.mass_matrix_inverse(q).astype(np.float64)
        at = {int(body): divmod(i, scene.body_count) for i, body in enumerate(self._body_rows.ravel())}
        com, own = to_numpy(self.model, "body_com"), to_numpy(self.model, "body_inertia")
        mass, inertia = np.zeros(len(bodies), np.float32), own[bodies].astype(np.float32)
        for i, (body, place) in enumerate(zip(bodies, endpoint_local_pos.numpy(), strict=True)):
            world, k = at[int(body)]
            R = np.array(wp.quat_to_matrix(wp.quat(*poses[world, k, 3:].tolist()))).reshape(3, 3)
            arm, spin = R @ (com[body] + place), J[world, k, 3:]
            linear = J[world, k, :3] + np.cross(spin.T, arm).T
            mobility = np.trace(linear @ minv[world] @ linear.T)
            mass[i] = 3.0 / mobility if mobility > 0.0 else 0.0
            turning = R.T @ (spin @ minv[world] @ spin.T) @ R
            if np.linalg.matrix_rank(turning, tol=1e-6 * max(np.trace(turning), 1e-30)) == 3:
                inertia[i] = np.linalg.inv(turning)
        out_mass.assign(mass)
        if out_inertia is not None and len(out_inertia):
            out_inertia.assign(inertia)

    def _check_open(self, call: str) -> None:
        """Raise UnsupportedError if loops are closed: these calls compute with the mass matrix of the tree."""
        if self.dynamics.closed:
            what = f"loops={self.dynamics.loops!r}"
            raise UnsupportedError(
                f"SolverSPO.{call}", what, "call solver.dynamics, or build the solver with loops='cut'"
            )

    def coupling_prepare_proxy_contacts(self, *_: Any, **__: Any) -> Any:
        """Raise NotImplementedError, because SolverSPO takes no contacts of proxies."""
        raise NotImplementedError(
            "SolverSPO cannot be a proxy coupling destination, because it takes no contacts; make it the source"
        )

    coupling_rewind_proxy_body = coupling_rewind_proxy_particle = coupling_prepare_proxy_contacts
    coupling_harvest_proxy_wrenches = coupling_harvest_proxy_particle_forces = coupling_prepare_proxy_contacts
