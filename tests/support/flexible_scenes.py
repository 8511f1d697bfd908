"""Scenes with flexible bodies, and operations on them that NumPy evaluates from their traces.

A kernel of a chain of many flexible bodies takes minutes to compile; its trace evaluated by NumPy, in any number of
worlds at once, is ready in seconds. That emitted code agrees with evaluated traces is tested elsewhere.
"""

import functools

import numpy as np

import warp_spo as spo
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace.evaluation import evaluate

from . import symbolic

FULL = {"y": 2, "z": 2, "torsion": 1, "axial": 1}


class Traced:
    """Operations of a scene in float64, evaluated by NumPy: ``traced("bias_force", q=..., qd=...)``, [world, ...]."""

    def __init__(self, scene):
        self.scene = scene
        self._stores = functools.cache(self._traced)

    def _traced(self, name, inputs):
        name = "inverse_dynamics" if name == "bias_force" else name
        return symbolic.function(name)(Trace(Links(self.scene), "float64", inputs))

    def __call__(self, name, **arrays):
        arrays = {key: np.asarray(value, float) for key, value in arrays.items()}
        stores = self._stores(name, tuple(arrays))
        worlds, n = len(arrays["q"]), self.scene.dof_count
        values = evaluate([store.value for store in stores], lambda array, at: arrays[array][(slice(None), *at)])
        bodies = self.scene.body_count
        shapes = {
            "body_poses": (bodies, 7),
            "body_velocities": (bodies, 6),
            "integrate": (self.scene.coord_count,),
            "mass_matrix": (n, n),
        }
        out = np.zeros((worlds, *shapes.get(name, () if name.endswith("energy") else (n,))))
        for store, value in zip(stores, values, strict=True):
            out[(slice(None), *store.index)] = value
        return out


def about(axis, angle):
    """The quaternion (xyzw) of a rotation about an axis."""
    return (*(np.sin(0.5 * angle) * np.asarray(axis, float)), np.cos(0.5 * angle))


def beam_chain(count, length, section, material, modes=FULL, *, ends="element", turn=0.0, stiffening=True, **values):
    """A chain of equal beams along x, and a body without mass at its tip; each is turned against the one before.

    Args:
        count: of beams. length: of each [m]. turn: angle about z between neighbours, half of it at the root [rad].
        values: arguments of :class:`spo.Scene`.
    """
    beam = spo.beam_modes(length, section, material, ends, modes, stiffening=stiffening)
    bodies, hinges = [], []
    for k in range(count):
        bodies.append(spo.Body(*beam.rigid, modes=beam, label=f"beam {k}"))
        place = (length if k else 0.0, 0.0, 0.0, *about((0, 0, 1), turn if k else 0.5 * turn))
        hinges.append(spo.Hinge("fixed", k - 1, k, parent_pose=place))
    bodies.append(spo.Body(0.0, label="tip"))
    hinges.append(spo.Hinge("fixed", count - 1, count, parent_pose=(length, 0, 0, 0, 0, 0, 1)))
    return spo.Scene(bodies, hinges, **{"gravity": (0, 0, 0), **values})


def difference(function, x, h):
    """Central differences of ``function`` ([world, n] to [world, m]) at x (n,): [m, n]."""
    steps = h * np.eye(len(x))
    values = function(np.concatenate([x + steps, x - steps]))
    return (values[: len(x)] - values[len(x) :]).T / (2.0 * h)


def equilibrium(scene, wrench=None, loads=1, tolerance=1e-10):
    """Scalar coordinates at which springs, gravity and a wrench on the last body balance, by Newton's method.

    Args:
        wrench: force and torque, world axes, at the body's centre of mass (6,).
        loads: steps in which the forces grow.
    """
    traced, q = Traced(scene), np.zeros(scene.coord_count)
    for load in range(1, loads + 1):
        body_f = np.zeros((1, scene.body_count, 6))
        body_f[0, -1] = 0.0 if wrench is None else np.asarray(wrench) * load / loads

        def residual(q, body_f=body_f):
            many = np.repeat(body_f, len(q), axis=0)
            return traced("passive_force", q=q, qd=0.0 * q) - traced("bias_force", q=q, body_f=many)

        for _ in range(30):
            change = -np.linalg.solve(difference(residual, q, 1e-6), residual(q[None])[0])
            q = q + change
            if np.abs(change).max() < tolerance * max(1.0, np.abs(q).max()):
                break
        else:
            raise AssertionError("Newton's method did not settle")
    return q


def place_of(scene, q, body=-1):
    """The origin of a body frame (3,)."""
    return Traced(scene)("body_poses", q=q[None])[0, body, :3]
