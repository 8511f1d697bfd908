"""A time step of bodies that touch, solved in joint space: each pass factors A = Mass + h S + h sum J* G J.

:mod:`warp_spo.reference.body_contact` is the specification. ``LANES`` threads of a warp take a world, whose matrices
lie in shared memory; on the CPU one thread does the same work. Contact points fill slots. Neither a pair nor a point
has code of its own: numbers of dofs, pairs and slots are constants, and what the scene has is read from tables. Every
value is computed by one lane, in an order that does not depend on ``LANES``; so results have equal bits for any number
of worlds and lanes.

Dofs are grouped by two, so that A consists of 2 x 2 tiles; the right side is one more row of tiles. Tiles that are not
zero are listed once a step, from the tree and from the pairs that are near. A lane forms a tile from all that it
consists of, and a pass through a column subtracts x D^-1 y* from the tiles to its right, x and y being tiles of the
column and D its diagonal one; so factors are A = L D^-1 L*, where L is the columns as they are met. The unknown is the
change of the velocity, whose rounding errors are those of the change.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import warp as wp

from . import joint_passes, joint_points, native
from .elementary import C_TYPE, FUSED

WORDS = {"PIVOT": 1, "NOT_FINITE": 2, "CONTACT": 8, "CROWDED": 9}
"""Status words, as warp_spo.Status, which kernels cannot import; a test compares."""
WARP = 32
WARPS, BLOCK_BYTES = 4, 64 * 1024  # of a block at most, if these are not more than one
MOST, POINT = 8, 7  # points of a near pair; entries of a point: place, normal towards the first body, depth
SURFACE = 11
"""Entries of a surface of the ground at a point: place, normal, depth; push and damping of its law; gap; 1 where the
point comes out slowly."""
LAW = 5
"""Entries of a law f(u) = scale clip(force - resistance u, least, most): force, resistance, least, most, scale."""
DOF_FIELDS, SLOT_FIELDS = 12, 13
RIGID = {wp.float32: 1e4, wp.float64: 1e12}
"""How many times the inertia that a point feels friction resists at most, in a step. At this bound a point that sticks
creeps by a part of 1e4 of the speed that an impact takes; an inertia beside more would be lost in rounding."""
FLOOR = {wp.float32: 1e-4, wp.float64: 1e-10}
"""Share of a dof's inertia at the neutral pose that a pivot is at least. It may be less only by rounding."""
DOF_VALUES = (
    "stiffness", "rest", "damping", "ke", "kd", "effort", "dry", "fastest", "brake", "weight",
    "lower", "upper", "limit_ke", "limit_kd",
)  # fmt: skip
"""Constants of a dof."""
SCREW = 9
"""Entries of what a dof moves: rate of turning and of moving, and the place that moves so, inertial axes."""
PAIR_VALUES = ("stiffness", "damping", "friction", "eps", "weight")
"""Constants of a pair, and then of a surface at a point with the ground; after all of them, half of gravity."""
NUMBERS = ("h", "passes", "most_force", "most_effort")
ARGUMENTS = [
    ("mass", 2), ("bias", 2), ("tau", 2), ("q", 2), ("qd", 2), ("target_q", 2), ("target_qd", 2), ("screws", 2),
    ("near", 1), ("touches", 2), ("surfaces", 2), ("motors", 2), ("dof_values", 2), ("pair_values", 2), ("place", 1),
    *((name, 0) for name in NUMBERS),
    ("out", 2), ("qdd", 2), ("contact_f", 3), ("contact_gap", 2), ("contact_slip", 2), ("excess", 2), ("status", 1),
]  # fmt: skip
"""Names and numbers of axes.

``dof_values``, ``pair_values``: a row for all worlds, or one for each.

``bias``, ``tau`` [world, dof]: the bias force, and the hinges' forces.
``near`` [world * (1 + 2 near pairs)]: how many pairs are near, which ones, and how many points each has.
"""


class Sizes(NamedTuple):
    """Sizes of a scene's system.

    Attributes:
        dofs, tiles: of the scene; block columns of two dofs each.
        entries: of the packed mass matrix. pairs, couples: pairs of shapes, pairs of bodies.
        columns: block columns of a couple at most. near: pairs at most that are near in a world. slots: points at most,
            those with the ground among them.
        surfaces, points: surfaces of the ground at points, each of which has a slot; points with the ground.
        laws: of motors and of springs, beside those that follow from constants of a dof.
        held: tiles of the mass matrix that are not zero.
        least: worlds that need at most so many slots are left to another kernel. leaves: so are those that need more
            than there are.
    """

    dofs: int
    tiles: int
    entries: int
    pairs: int
    couples: int
    columns: int
    near: int
    slots: int
    surfaces: int = 0
    points: int = 0
    laws: int = 0
    held: int = 0
    least: int = -1
    leaves: bool = False

    @property
    def words(self) -> int:
        """How many words of 32 bits a mask of block columns has."""
        return -(-self.tiles // 32)

    @property
    def slot_words(self) -> int:
        """How many words of 32 bits a mask of slots has."""
        return -(-self.slots // 32)

    @property
    def table_starts(self) -> dict[str, int]:
        """Where each table of integers begins in ``place``, in this order, and how long all are."""
        sizes = {
            "DOF_OF": 2 * self.tiles, "ENTRY": self.entries, "MASK": self.tiles * self.words,
            "HELD": self.tiles * (self.tiles + 1) // 2, "BLOCKS": self.couples * self.words,
            "COUPLE": (1 + self.columns) * self.couples, "PAIR": 2 * (self.pairs + self.surfaces),
            "COORDINATE": self.dofs, "ROW_START": 2 * self.tiles + 1,
            "ROW": 2 * self.entries - self.dofs, "LAW": self.dofs + 1,
        }  # fmt: skip
        starts, at = {}, 0
        for name, size in sizes.items():
            starts[name], at = at, at + size
        return starts | {"END": at}


def shared_layout(sizes: Sizes, T: type) -> tuple[dict[str, int], int]:
    """Return where arrays of a world begin in shared memory, in scalars and then in bytes, and its bytes."""
    b, real = sizes.tiles, 4 if T is wp.float32 else 8
    starts, at = {}, 0
    reals = {
        "AT_A": max(4 * (b * (b + 1) // 2 + b), SCREW * sizes.dofs),
        "AT_J": 6 * sizes.columns * sizes.slots, "AT_SLOT": SLOT_FIELDS * sizes.slots, "AT_DOF": DOF_FIELDS * 2 * b,
        "AT_M": 4 * sizes.held,
        "AT_SHARE": sizes.laws,
    }  # fmt: skip
    for name, size in reals.items():
        starts[name], at = at, at + -(-size // 4) * 4
    at *= real
    parts = {
        "AT_MASK": 4 * b * sizes.words, "AT_TOUCHING": 4 * b * sizes.slot_words, "AT_ACTIVE": 4 * sizes.slot_words,
        "AT_SLOT_OF": 4 * sizes.slots, "AT_SLOT_PAIR": 4 * sizes.slots, "AT_SLOT_MASK": 4 * sizes.slots * sizes.words,
        "AT_KEEP": 4 * sizes.near, "AT_BEGIN": 4 * (sizes.near + 1), "AT_START": 4 * (b + 1), "AT_LIST": b * (b + 3),
    }  # fmt: skip
    for name, size in parts.items():
        starts[name], at = at, at + -(-size // 8) * 8
    return starts, at + (16 - at) % 128  # worlds of a warp begin in different banks


def threads_of_block(sizes: Sizes, T: type, lanes: int) -> int:
    """Return how many threads a block has."""
    return WARP * max(1, min(WARPS, BLOCK_BYTES // (world_bytes(sizes, T) * (WARP // lanes))))


def world_bytes(sizes: Sizes, T: type) -> int:
    """Return the shared memory of a world."""
    return shared_layout(sizes, T)[1]


@functools.cache
def solver(sizes: Sizes, T: type, lanes: int = 32, registers: int | None = None, refine: int = 1) -> wp.Kernel:
    """Return the kernel of a step; ``lanes`` of 8, 16 or 32 threads of a warp take a world on CUDA.

    ``refine``: steps of iterative refinement in the last pass.

    It launches ``lanes * worlds`` threads on CUDA, ``worlds`` on the CPU, in blocks of :func:`threads_of_block`.
    """
    passes = joint_passes.PASSES.replace(joint_passes.AFTER_A_PASS, "")
    text = native_text(passes + joint_passes.RESULTS + joint_passes.END, sizes, T, lanes, refine)
    shared = world_bytes(sizes, T) * (threads_of_block(sizes, T, lanes) // lanes)
    return native.kernel("joint_space", text, ARGUMENTS, T, registers=registers, shared=shared)


def native_text(text: str, sizes: Sizes, T: type, lanes: int, refine: int) -> str:
    """Return the native text of a kernel that goes on with ``text`` where points have slots and Jacobians."""
    starts, size = shared_layout(sizes, T)
    constants = {
        "DOFS": sizes.dofs, "N": 2 * sizes.tiles, "NB": sizes.tiles, "NNZ": sizes.entries, "PAIRS": sizes.pairs,
        "MB": sizes.columns, "NEAR": sizes.near, "S": sizes.slots, "BYTES": size, "MOST": MOST, "POINT": POINT,
        "DV": len(DOF_VALUES), "PV": len(PAIR_VALUES), "TILES": sizes.tiles * (sizes.tiles + 1) // 2 + sizes.tiles,
        "REFINE": refine, "SURFACE": SURFACE, "SURFACES": sizes.surfaces, "CONTACT_POINTS": sizes.points,
        "WORDS": sizes.words, "SLOT_WORDS": sizes.slot_words, "HELD": sizes.held,
        "LEAST": sizes.least, "LEAVES": int(sizes.leaves),
        "DOF_FIELDS": DOF_FIELDS, "SLOT_FIELDS": SLOT_FIELDS,
        "LAW": LAW, "LAWS": sizes.laws, "SCREW": SCREW,
    }  # fmt: skip
    constants |= WORDS | starts | {f"T_{name}": at for name, at in sizes.table_starts.items()}
    constants |= {f"C_{name.upper()}": i for i, name in enumerate(DOF_VALUES)}
    constants |= {f"P_{name.upper()}": i for i, name in enumerate(PAIR_VALUES)}
    c = C_TYPE[T]
    text = (joint_points.FUNCTIONS + joint_points.POINTS + text).replace(
        "CONSTANTS", ", ".join(f"{name} = {x}" for name, x in constants.items())
    )
    text = text.replace("UNROLL_LANES\n", "\n#if defined(__CUDA_ARCH__)\n#pragma unroll\n#endif\n")
    text = text.replace("UNROLL\n", "#pragma unroll\n").replace("LOOP\n", "#pragma unroll 1\n")
    text = (
        text.replace("AWAY", "(REAL)INFINITY")
        .replace("(REAL)RIGID", f"(REAL){RIGID[T]:g}")
        .replace("(REAL)FLOOR", f"(REAL){FLOOR[T]:g}")
        .replace("LANE_COUNT", str(lanes))
        .replace("REAL", c)
        .replace("FMA(", f"FUSED_{c}(")
    )
    inverse = 'asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));' if T is wp.float32 else "y = 1 / x;"
    text = text.replace("INVERSE_ROOT(", "rsqrtf(" if T is wp.float32 else "rsqrt(")
    return FUSED + text.replace("INVERSE\n", f"{inverse}\n")
