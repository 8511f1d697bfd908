"""Inverse kinematics: coordinates at which frames have wanted poses, by damped least squares from several starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..errors import UnsupportedError, as_integer
from ..execution import multi_start
from ..execution.routine import Routine
from ..kernels import declare
from ..kernels import multi_start as kernels
from ..recursions import inverse_kinematics as recursion
from ..runtime.arrays import AnyArray, ArrayT, Call
from ..scene.frames import Frame
from ..scene.parts import UNLIMITED
from ..scene.scene import Scene
from .operation import ORIENTED_FRAMES, Argument, Operation, Option, Refused, Result
from .trial_inputs import rotations

if TYPE_CHECKING:
    from .dynamics import Dynamics

ANGLE_WEIGHT = 1e-3 / math.radians(0.1)  # [m/rad]: 0.1 degrees count as much as 1 mm
ITERATIONS = 20


def _count(name: str, least: int) -> Any:
    def read(scene: Scene, call: Call, value: Any) -> int:
        count = as_integer(value)
        if count is None or count < least:
            raise ValueError(f"{call.name}: {name} is {value!r}; expected a whole number, {least} or more")
        return count

    return read


def _weight(scene: Scene, call: Call, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0.0 <= value < math.inf:
        raise ValueError(f"{call.name}: angle_weight is {value!r}; expected a number of m/rad, 0 or more")
    return float(value)


INVERSE_KINEMATICS = Operation(
    "inverse_kinematics",
    arguments=(
        Argument("targets", "world, frame, 7"),
        ORIENTED_FRAMES,
        Argument("q", "world, coordinate", optional=True, asked=True),
        Option("seeds", _count("seeds", 1), lambda scene: 1),
        Option("iterations", _count("iterations", 0), lambda scene: ITERATIONS),
        Option("angle_weight", _weight, lambda scene: ANGLE_WEIGHT),
    ),
    results=(Result("q", "world, coordinate", quaternions=rotations), Result("error", "world")),
    routine=Routine("inverse_kinematics", recursion.inverse_kinematics_step, start=recursion.inverse_kinematics_start),
    embed=Refused(),
    multipliers=Refused(),
)


@INVERSE_KINEMATICS.method
def inverse_kinematics(
    self: Dynamics,
    targets: ArrayT,
    frames: Sequence[Frame],
    q: AnyArray | None = None,
    seeds: int = 1,
    iterations: int = ITERATIONS,
    angle_weight: float = ANGLE_WEIGHT,
    out: tuple[ArrayT | None, ArrayT | None] = (None, None),
) -> tuple[ArrayT, ArrayT]:
    """Search coordinates within the limits at which every frame has its target pose.

    From each start, ``iterations`` steps of damped least squares are made, and the best coordinates met on the way are
    kept; of all starts of a world, those with the least error are returned. One thread works on a start. All of it is
    two launches, or three for positions alone, which a graph can capture, and the numbers of seeds and iterations are
    fixed: the error says whether a target was reached. One seed, the default, serves targets near ``q``, within
    0.3 rad of each joint for example; of poses far from it, it reaches about half or fewer. Of those that Panda and UR5
    take at random configurations within their limits, 1 seed reaches 40 to 60 %, 4 seeds 92 to 95 %, 16 seeds 99.8 %
    or more; on other robots few seeds may reach fewer.

    The error [m] of a world is the largest, over its frames, of the distance between the frame's origin and its target,
    and of the angle between their axes times ``angle_weight``. With the default weight an error below 1e-3 says that
    every frame is within 1 mm and within 0.1 degrees of its target. The search weighs angles alike.

    The starts are the same in all worlds and on all devices. Start k = 1, 2 ... of coordinate d = 0 to n - 1 lies at
    the share frac(1/2 + k / a^(d+1)) of the way between the limits, where a^(n+1) = a + 1: M. Roberts' sequence, which
    covers the ranges evenly. Coordinates without limits start between -pi and pi, or -1 m and 1 m. A quaternion takes
    three shares, spread evenly over all rotations (K. Shoemake). More seeds contain the starts of fewer.

    Coordinates that move none of the frames keep their values in ``q``; without ``q``, the neutral ones. Deflections of
    flexible hinges are zero where they move a frame.

    Args:
        targets: pose of each frame in the inertial frame [world, frame, 7]: x, y, z [m], quaternion xyzw.
        frames: bodies, sites, or pairs (body or site, pose in it), as :meth:`frame_poses`.
        q: where the first seed starts [world, coordinate], brought within the limits; None: at the first start above.
        seeds: number of starts for each world. The first call with another number allocates.
        iterations: steps from each start.
        angle_weight: what 1 rad counts as [m/rad]. 0 for positions alone: the quaternions of the targets do not matter
            then, and may be zero.
        out: (q, error), each an array or None.

    Returns:
        q [world, coordinate], quaternions of unit length, and error [world] [m]. NaN in a world whose target is NaN.

    Raises:
        UnsupportedError: closed loops, limits of a ball or free hinge that moves a frame, or nothing moves.
    """
    engine = self._engine
    with engine.call(INVERSE_KINEMATICS) as call:
        outs = engine.outs(call, INVERSE_KINEMATICS, out)
        named = dict(frames=frames, seeds=seeds, iterations=iterations, angle_weight=angle_weight)
        given = engine.read(call, INVERSE_KINEMATICS, targets=targets, q=q, **named)
        frames, seeds = given["frames"], given["seeds"]
        _check_limits(self.scene, call)
        results = engine.write(call, INVERSE_KINEMATICS, outs, given)
        wanted: Any = given["targets"]
        if given["angle_weight"] == 0.0:
            plain = self.recursions.array(("positions", *wanted.shape), *wanted.shape)
            self.recursions.launch(kernels.take_positions, wanted.shape[:2], [wanted], [plain])
            wanted = plain
        arrays = {"target": wanted, "share": _shares(self, seeds)}
        if given["q"] is not None:
            arrays["given"] = given["q"]
        shapes = {name: array.shape for name, array in arrays.items()}
        assert INVERSE_KINEMATICS.routine is not None
        program = self.programs.find(INVERSE_KINEMATICS.routine, shapes, results[0].shape, frames=frames)
        assert program is not None
        found = self.recursions.array(("found", seeds), self.scene.coord_count, seeds, self.worlds)
        errors = self.recursions.array(("errors", seeds), seeds, self.worlds)
        multi_start.launch(
            self.programs, program, given["angle_weight"], given["iterations"], arrays, found, errors, *results
        )
    return call.result


def _check_limits(scene: Scene, call: Call) -> None:
    """Raise UnsupportedError where nothing moves, or a quaternion has limits."""
    if scene.dof_count == 0:
        raise UnsupportedError(call.name, "a scene that cannot move", "compare its frame_poses with the targets")
    sides = scene.values["joint_limit_lower"], scene.values["joint_limit_upper"]
    for hinge, first in zip(scene.hinges, scene.qd_start, strict=False):
        dofs = slice(first, first + hinge.dof_count)
        if hinge.quaternions and any((np.abs(side[:, dofs]) < UNLIMITED).any() for side in sides):
            way = f"leave limits at {UNLIMITED:.0e} there"
            raise UnsupportedError(call.name, f"limits of the {hinge.kind} hinge {hinge.label!r}", way)


def _shares(dyn: Dynamics, seeds: int) -> wp.array:
    """Return the starts [seed, coordinate] on the device, as shares of ranges and as quaternions."""
    if seeds not in dyn._starts:
        declare(kernels, dyn.dtype)
        dyn._starts[seeds] = wp.array(starts(dyn.scene, seeds), dtype=dyn.dtype, device=dyn.device)
    return dyn._starts[seeds]


def starts(scene: Scene, seeds: int) -> np.ndarray:
    """Return shares of ranges, and quaternions, of the first starts [seed, coordinate], in float64."""
    count = scene.coord_count - len(rotations(scene))  # a quaternion takes three
    ratio = 2.0
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (count + 1))
    powers = ratio ** -np.arange(1.0, count + 1)
    shares = (0.5 + np.arange(1, seeds + 1)[:, None] * powers) % 1.0
    found, taken, quaternions = np.empty((seeds, scene.coord_count)), 0, set(rotations(scene))
    coordinate = 0
    while coordinate < scene.coord_count:
        if coordinate not in quaternions:
            found[:, coordinate] = shares[:, taken]
            coordinate, taken = coordinate + 1, taken + 1
            continue
        a, b, c = shares[:, taken : taken + 3].T
        b, c = 2.0 * np.pi * b, 2.0 * np.pi * c
        quaternion = [
            np.sqrt(1 - a) * np.sin(b),
            np.sqrt(1 - a) * np.cos(b),
            np.sqrt(a) * np.sin(c),
            np.sqrt(a) * np.cos(c),
        ]
        found[:, coordinate : coordinate + 4] = np.transpose(quaternion)
        coordinate, taken = coordinate + 4, taken + 3
    return found
