"""Limits of MuJoCo's joints, as springs and dampers.

MuJoCo's limits are soft in acceleration ("Computation", "Constraint model"). At depth r beyond a limit its force is

    f = I d / (1 - d) (k d r + b r' + r''),    I = 1 / dof_invweight0,

with stiffness k and damping b from ``solreflimit``, and the impedance d(r), between 0 and 1, from ``solimplimit``. A
limb of that inertia moves by r'' = -k d^2 r - b d r' + (1 - d) load / I. Hence it rests where a spring of stiffness
I k d^2 / (1 - d) would hold it, and it comes to rest with the damping ratio b / (2 sqrt(k)).

A scene's limit is one spring and one damper. They are those of d at the depth where the limb rests in MuJoCo under its
own weight: K = I k d^2 / (1 - d), and D = I b d / sqrt(1 - d), which has the same damping ratio. The weight is that at
the bound, all other joints at qpos0. Where it pushes against both bounds, the depth is the geometric mean of both.
Where it pushes against neither, as on a vertical axis, the load is the limb's weight at its lever.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from ..scene.parts import UNLIMITED
from .source import Source

MINVAL, LEAST, MOST = 1e-15, 1e-4, 0.9999  # mjMINVAL, mjMINIMP, mjMAXIMP of MuJoCo
DEFAULT_SOLREF = (0.02, 1.0)  # what MuJoCo takes for a solref of mixed signs
DEPTHS = np.logspace(-15.0, 3.0, 721)  # [rad or m], among which the depth at rest is looked for
ROUNDS, PARTS = 3, 100  # intervals of DEPTHS are 6 % of the depth; each round looks into a hundredth of one
EARTH = np.array([0.0, 0.0, -9.81])  # [m/s^2], where the model has no gravity
ROUNDING = 1e-9  # share of a limb's weight, or of its radius of gyration, below which a push or a lever is none

OfDepth = Callable[[np.ndarray], np.ndarray]


def limit_reference(solref: np.ndarray, most: float, least_time: float = 0.0) -> tuple[float, float]:
    """Return MuJoCo's stiffness k [1/s^2] and damping b [1/s] of a constraint.

    Args:
        solref: time constant and damping ratio if both are positive; else -k and -b before they are scaled.
        most: the largest impedance, ``solimp[1]``. least_time: of a time constant [s], two steps under "refsafe".
    """
    most = float(np.clip(most, LEAST, MOST))
    first, second = (float(x) for x in (DEFAULT_SOLREF if (solref[0] > 0.0) != (solref[1] > 0.0) else solref))
    if first <= 0.0:
        return -first / most**2, -second / most
    time = max(first, least_time)
    return 1.0 / max(MINVAL, (most * time * second) ** 2), 2.0 / max(MINVAL, most * time)


def impedance(solimp: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return MuJoCo's impedance d of a constraint at depths [rad or m]."""
    first, last, middle = np.clip(solimp[[0, 1, 3]], LEAST, MOST)
    width, power = max(float(solimp[2]), 0.0), max(float(solimp[4]), 1.0)
    if width <= MINVAL or first == last:
        return np.full(np.shape(depth), 0.5 * (first + last))
    x = np.minimum(depth / width, 1.0)
    low, high = middle * (x / middle) ** power, 1.0 - (1.0 - middle) * ((1.0 - x) / (1.0 - middle)) ** power
    return first + (last - first) * np.where(x <= middle, low, high)


def rest_depth(stiffness: OfDepth, load: OfDepth) -> float:
    """Return the least depth at which stiffness times depth carries the load, both functions of the depth."""
    depths = DEPTHS
    for _ in range(ROUNDS):
        carried = np.flatnonzero(stiffness(depths) * depths >= load(depths))
        if not carried.size or not carried[0]:
            return float(depths[carried[0] if carried.size else -1])
        depths = np.linspace(depths[carried[0] - 1], depths[carried[0]], PARTS)
    return float(depths.mean())


class JointLimits:
    """Springs and dampers of the limits of a model's hinges and slides.

    A limb is all that a joint carries. Its weight is that of the model's gravity, less ``gravcomp``, or that on Earth
    in a model without gravity.
    """

    def __init__(self, source: Source):
        m, data = source.model, mujoco.MjData(source.model)
        mujoco.mj_kinematics(m, data)
        self._model = m
        self._least_time = 0.0 if source.disabled("REFSAFE") else 2.0 * m.opt.timestep
        gravity = EARTH if source.disabled("GRAVITY") or not m.opt.gravity.any() else np.array(m.opt.gravity)

        masses = m.body_mass * (1.0 - m.body_gravcomp)
        limb_mass, moment = masses.copy(), masses[:, None] * data.xipos
        for body in range(m.nbody - 1, 0, -1):
            limb_mass[m.body_parentid[body]] += limb_mass[body]
            moment[m.body_parentid[body]] += moment[body]

        mass, axis = limb_mass[m.jnt_bodyid], data.xaxis  # [joint]
        arm = moment[m.jnt_bodyid] / np.where(mass == 0.0, 1.0, mass)[:, None] - data.xanchor
        across = np.cross(np.cross(axis, arm), axis)  # the arm, square to the axis
        slides, force = m.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE, mass[:, None] * gravity
        turned = np.cross(axis, across)  # the arm after a quarter turn
        self._now = _dots(axis, np.where(slides[:, None], force, np.cross(across, force)))
        self._turned = _dots(axis, np.cross(turned, force))
        self._turns, self._reference = np.where(slides, 0.0, 1.0), m.qpos0[m.jnt_qposadr]

        inverse = m.dof_invweight0[m.jnt_dofadr]
        self._inertia = 1.0 / np.where(inverse > 0.0, inverse, 1.0)
        lever, gyration = np.linalg.norm(across, axis=1), np.sqrt(self._inertia / np.maximum(abs(mass), MINVAL))
        lever = np.where(slides, 1.0, np.where(lever > ROUNDING * gyration, lever, gyration))
        self._weight = lever * np.linalg.norm(force, axis=1)  # of limbs at their levers [N or N m]

    def gains(self, joint: int, lower: float, upper: float) -> tuple[float, float]:
        """Return the stiffness and the damping of a joint's limits, which are at ``lower`` and ``upper``."""
        solimp, inertia, whole = np.array(self._model.jnt_solimp[joint]), self._inertia[joint], self._weight[joint]
        k, b = limit_reference(self._model.jnt_solref[joint], solimp[1], self._least_time)

        def stiffness(depth: np.ndarray) -> np.ndarray:
            d = impedance(solimp, depth)
            return inertia * k * d**2 / (1.0 - d)

        bounds: list[tuple[float, OfDepth]] = [
            (lower, lambda r: -self._push(joint, lower - r)),
            (upper, lambda r: self._push(joint, upper + r)),
        ]
        loads = [f for bound, f in bounds if abs(bound) < UNLIMITED and f(np.zeros(1))[0] > ROUNDING * whole]
        loads = loads or [lambda r: np.full(r.shape, whole)]
        depth = np.exp(np.mean([np.log(rest_depth(stiffness, load)) for load in loads], keepdims=True))
        d = float(impedance(solimp, depth)[0])
        return float(stiffness(depth)[0]), float(inertia * b * d / np.sqrt(1.0 - d))

    def _push(self, joint: int, positions: np.ndarray) -> np.ndarray:
        """Return the generalised force of the limb's weight on a joint at positions [N m or N]."""
        angles = self._turns[joint] * (positions - self._reference[joint])
        return self._now[joint] * np.cos(angles) + self._turned[joint] * np.sin(angles)


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)
