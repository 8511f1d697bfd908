"""States, accelerations and forces of MuJoCo and of a scene, each from the other, on the device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import warp as wp

from ..errors import as_integer, never_copied
from ..kernels import declare
from ..kernels import mujoco_states as kernels
from ..runtime.arrays import AnyArray, ArrayT, Call, parse_device, parse_dtype
from ..runtime.memory import broadcast_worlds
from ..scene.parts import Hinge
from ..scene.scene import Scene
from .mechanism import BALL, FREE, KINDS


class Coordinates:
    """Converts between MuJoCo's ``qpos``, ``qvel``, ``qacc``, ``qfrc`` and a scene's ``q``, ``qd``, ``qdd``, ``tau``.

    ``qpos`` and ``q`` differ in the order of quaternions alone: w, x, y, z in MuJoCo and x, y, z, w here; entries
    keep their places, and nothing is normalised. ``qvel`` and ``qd`` differ for ball joints, whose angular velocity is
    in the body's axes in MuJoCo and in the parent anchor's here, and for free joints: there the velocity of the body
    frame's origin in world axes, then the angular velocity in the body's axes; here the velocity of the centre of mass,
    then the angular velocity, both in world axes. ``qacc`` and ``qdd`` are the time derivatives of ``qvel`` and ``qd``;
    forces have the same power in both, ``qfrc . qvel = tau . qd``. Each call launches one kernel and is exact to
    rounding.

    Args:
        scene: what ``from_mujoco(model)`` or ``load(path)`` returned; its centres of mass are those of ``body_com``,
            for each world if they differ between worlds.
        model: the ``mujoco.MjModel``.
        worlds: number of worlds; None is the scene's.
        device: Warp's current device unless given.
        dtype: "float32" or "float64".

    Raises:
        TypeError: ``model`` is not a ``mujoco.MjModel``.
        ValueError: the scene's joints are not those of the model, or the number of worlds is not the scene's.

    All methods take and return arrays as :class:`Dynamics` does: torch, Warp or NumPy, ``[world, ...]``, with ``out=``;
    torch and Warp arrays are not copied, and a call with ``out=`` can be captured.
    """

    __reduce__ = never_copied("Coordinates", "memory of a device", "store the scene and the MjModel, and make it anew")

    def __init__(self, scene: Scene, model: Any, worlds: int | None = None, device: Any = None, dtype: Any = "float32"):
        if not isinstance(model, mujoco.MjModel):
            raise TypeError(f"Coordinates: model is of type {type(model).__name__}; expected mujoco.MjModel")
        moving = _moving_hinges(scene, model)
        self.worlds = scene.worlds if worlds is None else worlds
        if as_integer(self.worlds) is None or self.worlds < 1 or scene.worlds not in (1, self.worlds):
            wanted = "one or more" if scene.worlds == 1 else f"{scene.worlds}, as the scene has"
            raise ValueError(f"Coordinates: worlds is {worlds!r}; expected {wanted}")
        self.device, self.dtype = parse_device(device, "Coordinates"), parse_dtype(dtype, "Coordinates")
        self.coord_count, self.dof_count, self.joint_count = model.nq, model.nv, model.njnt
        declare(kernels, self.dtype)

        kind = np.select([model.jnt_type == BALL, model.jnt_type == FREE], [1, 2], 0)
        turn = model.jnt_qposadr + np.where(kind == 2, 3, 0)  # first entry of the quaternion
        to_scene, to_mujoco = np.arange(model.nq), np.arange(model.nq)
        for first in turn[kind > 0]:
            to_scene[first : first + 4] = first + np.array([1, 2, 3, 0])
            to_mujoco[first : first + 4] = first + np.array([3, 0, 1, 2])
        com = scene.values["body_com"][:, [scene.hinges[hinge].child for hinge in moving]]
        self._sources = self._table(to_scene), self._table(to_mujoco)
        self._com = broadcast_worlds(wp.array(com, dtype=self.dtype, device=self.device), 0, self.worlds)
        joints = self._table(kind), self._table(model.jnt_dofadr)
        self._rates = {
            True: (*joints, self._table(turn + 1), self._table(turn)),
            False: (*joints, self._table(turn), self._table(turn + 3)),
        }

    def q(self, qpos: ArrayT, out: ArrayT | None = None) -> ArrayT:
        """Return q [world, coordinate] of ``qpos`` [world, nq] [m, rad]."""
        return self._gather("q", "qpos", qpos, out, self._sources[0])

    def qpos(self, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
        """Return qpos [world, nq] of ``q`` [world, coordinate] [m, rad]."""
        return self._gather("qpos", "q", q, out, self._sources[1])

    def qd(self, qpos: ArrayT, qvel: AnyArray, out: ArrayT | None = None) -> ArrayT:
        """Return qd [world, dof] of ``qpos`` [world, nq] and ``qvel`` [world, nv] [m/s, rad/s]."""
        return self._convert("qd", kernels.rates, True, {"qpos": qpos, "qvel": qvel}, out)

    def qvel(self, q: ArrayT, qd: AnyArray, out: ArrayT | None = None) -> ArrayT:
        """Return qvel [world, nv] of ``q`` [world, coordinate] and ``qd`` [world, dof] [m/s, rad/s]."""
        return self._convert("qvel", kernels.rates, False, {"q": q, "qd": qd}, out)

    def qdd(self, qpos: ArrayT, qvel: AnyArray, qacc: AnyArray, out: ArrayT | None = None) -> ArrayT:
        """Return qdd [world, dof] of ``qpos`` [world, nq], ``qvel`` and ``qacc`` [world, nv] [m/s^2, rad/s^2]."""
        return self._convert("qdd", kernels.accelerations, True, {"qpos": qpos, "qvel": qvel, "qacc": qacc}, out)

    def qacc(self, q: ArrayT, qd: AnyArray, qdd: AnyArray, out: ArrayT | None = None) -> ArrayT:
        """Return qacc [world, nv] of ``q`` [world, coordinate], ``qd`` and ``qdd`` [world, dof] [m/s^2, rad/s^2]."""
        return self._convert("qacc", kernels.accelerations, False, {"q": q, "qd": qd, "qdd": qdd}, out)

    def tau(self, qpos: ArrayT, qfrc: AnyArray, out: ArrayT | None = None) -> ArrayT:
        """Return tau [world, dof] of ``qpos`` [world, nq] and ``qfrc`` [world, nv] [N, N m]."""
        return self._convert("tau", kernels.forces, True, {"qpos": qpos, "qfrc": qfrc}, out)

    def qfrc(self, q: ArrayT, tau: AnyArray, out: ArrayT | None = None) -> ArrayT:
        """Return qfrc [world, nv], as MuJoCo adds up, of ``q`` and ``tau`` [world, dof] [N, N m]."""
        return self._convert("qfrc", kernels.forces, False, {"q": q, "tau": tau}, out)

    def _table(self, numbers: Any) -> wp.array:
        return wp.array(np.array(numbers, dtype=np.int32), dtype=int, device=self.device)

    def _gather(self, name: str, argument: str, array: Any, out: Any, source: wp.array) -> Any:
        shape = (self.worlds, self.coord_count)
        with Call(f"Coordinates.{name}", self.device, self.dtype) as call:
            x = call.read(argument, array, shape, "[world, coordinate]")
            result = call.write(out, shape, "[world, coordinate]")
            wp.launch(kernels.gather(self.dtype), shape, [source, x], [result], device=self.device)
        return call.result

    def _convert(
        self, name: str, factory: Callable[[type], wp.Kernel], to_scene: bool, arguments: dict[str, Any], out: Any
    ) -> Any:
        states = ((self.worlds, self.coord_count), "[world, coordinate]")
        rates = ((self.worlds, self.dof_count), "[world, dof]")
        with Call(f"Coordinates.{name}", self.device, self.dtype) as call:
            first, *others = arguments.items()
            read = [call.read(*first, *states), *(call.read(*other, *rates) for other in others)]
            result = call.write(out, *rates)
            wp.launch(
                factory(self.dtype),
                (self.worlds, self.joint_count),
                [to_scene, *self._rates[to_scene], self._com, *read],
                [result],
                device=self.device,
            )
        return call.result


def _moving_hinges(scene: Scene, model: mujoco.MjModel) -> list[int]:
    """Return the hinge of each joint of the model; ValueError if the scene's hinges are not the model's joints."""
    moving = [index for index, hinge in enumerate(scene.hinges) if hinge.dof_count]
    kinds = [_kind(scene.hinges[index]) for index in moving]
    expected = [KINDS[int(kind)] for kind in model.jnt_type]
    if kinds != expected:
        at = next((i for i, (a, b) in enumerate(zip(kinds, expected, strict=False)) if a != b), None)
        came = f"{len(kinds)} joints that move" if at is None else f"joint {at} {kinds[at]}"
        wanted = f"{len(expected)}" if at is None else expected[at]
        raise ValueError(
            f"Coordinates: the scene has {came}; expected {wanted}, as the model; pass from_mujoco(model), or the "
            "scene that load(path) returns without floating="
        )
    return moving


def _kind(hinge: Hinge) -> str:
    """Return a hinge's kind, and how many degrees of freedom it has if it is flexible or carries a flexible body."""
    own = {"ball": 3, "free": 6}.get(hinge.kind, 1)
    return hinge.kind if hinge.dof_count == own else f"{hinge.kind} of {hinge.dof_count} degrees of freedom"
