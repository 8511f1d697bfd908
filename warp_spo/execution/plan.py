"""Every choice about how a scene runs on a device, made in one place and said aloud by ``explain()``."""

from __future__ import annotations

import dataclasses

from ..kernels.slots import WARP_SIZE
from ..recursions.links import Links
from ..recursions.pieces import Pieces
from ..scene.scene import Scene

GRANULARITIES = ("node", "segment", "tree")
DEFAULT: str | None = None  # granularity of who asks for none; None: chosen by the rules below
COLUMN_BYTES = 1 << 28  # workspace of a solve with many right-hand sides; more columns go in turns

# Measured on an H200, 2026-11-21; see CONTRIBUTING.
FEW_WORLDS = 32768  # so many leave a GPU waiting: a warp for each limb, and rows read where they are
MOST_DOFS = 128  # straight-line code of more takes too long to compile
SPILLS = {"float32": 32, "float64": 15}  # dofs at which one thread no longer holds a whole tree in registers,
SOLVES = {"float32": 32, "float64": 20}  # and at which it does not without velocities
ALIKE = {"float32": 0.5, "float64": 0.0}  # share of limbs that share code; below it a thread a world is faster then
HELD = 16  # dofs of which a thread holds the variable values, too
SHORT_ROWS = 10  # dofs up to which a thread's own row is read as fast as through shared memory,
LONG_ROWS = 24  # in segments; longer rows come in together already at fewer worlds
FEW_RESULTS = 2  # short ones that a thread writes by itself
MOST_WARPS = 16
DEEPEST = 12  # dofs from a root to a leaf, a free hinge one, up to which velocity terms that come first are as accurate
APART = {"chain": 2048, "tree": 4 * FEW_WORLDS, "segment": FEW_WORLDS}  # worlds beyond which they are faster
SHORT = ("inverse_dynamics", "bias_force", "gravity_force")  # little code: a thread for the whole tree does not spill
GATHERED = ("forward_dynamics", "forward_dynamics_apart")  # by limbs with short rows: work enough for a barrier more
LONG_RESULTS = ("mass_matrix", "mass_matrix_inverse")  # writing them is most of the work, and goes faster by many warps

SEGMENTED = ("forward_dynamics", "solve_mass_matrix", *LONG_RESULTS, *SHORT)
"""Operations that a warp a limb can share; the others run with a thread a world where the plan says segment."""
TREE_ONLY = (
    "hybrid_dynamics",
    "jacobian_bias",
    "frame_accelerations",
    "operational_inertia_inverse_product",
    "com_jacobian",
    "centroidal_momentum_matrix",
    "centroidal_momentum_bias",
    "quasi_velocities",
    "log_det_mass_matrix_gradient",
    "fixman_torque",
    "mass_matrix_packed",
    "mass_matrix_inverse_packed",
    "inverse_dynamics_derivatives",
    "mass_matrix_derivative",
    "solve_mass_matrix_vjp",
    "mass_matrix_vjp",
    "jacobian_vjp",
    "integrate_vjp",
    "step_vjp",
    "body_poses_vjp",
    "body_velocities_vjp",
    "forward_dynamics_jvp",
    "inverse_dynamics_jvp",
    "step_system",
    "integrate",
    "passive_force",
    "hinge_force",
    "coordinate_rates",
    "body_accelerations",
    "body_reactions",
    "embedded_forward_dynamics",
    "embedded_inverse_dynamics",
    "embedded_mass_matrix",
    "embedded_mass_matrix_inverse",
    "embedded_solve_mass_matrix",
    "embedded_log_det_mass_matrix",
    "embedded_operational_inertia_inverse",
    "embedded_operational_inertia_inverse_product",
    "embedded_hybrid_dynamics",
    "embedded_jacobian",
    "embedded_jacobian_bias",
    "embedded_com_jacobian",
    "embedded_centroidal_momentum_matrix",
    "embedded_centroidal_momentum_bias",
    "embedded_forward_dynamics_vjp",
    "embedded_forward_dynamics_jvp",
    "embedded_inverse_dynamics_vjp",
    "embedded_inverse_dynamics_jvp",
    "embedded_step_vjp",
    "closure_error",
    "project_position",
    "project_velocity",
    "loop_system",
    "loop_forward_dynamics",
    "closure_system",
    "closure_step",
    "closures_open",
)
"""Operations that exist as traces alone: each is a kernel of its scene, a thread a world, whatever the plan."""
SHARED = ("step", "forward_dynamics_and_solve", "forward_dynamics_vjp", "inverse_dynamics_vjp")
"""Traces alone, too, that a warp a limb can share."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """How the recursions of one scene are cut into kernels.

    Attributes:
        granularity: "node": one thread works on one node of a level in one world, a launch a level. "segment": a warp
            works on one serial chain of 32 worlds, a block on 32 worlds. "tree": one thread works on one world.
        reason: why.
        forced: the user asked for it.
        staged: rows of many worlds come in through shared memory, see :meth:`stages`.
        outward: (first, count) into the nodes ordered by level, roots first.
        worlds: number of worlds.
        dtype: "float32" or "float64".
        dofs: of the scene.
        limbs: serial chains that end in a leaf; counted where it matters.
        apart: forward dynamics takes velocity terms and loads first, and keeps no link's velocity for the rest.
        varies: inertias or hinge frames come from memory.
    """

    granularity: str
    reason: str
    forced: bool
    staged: bool
    outward: tuple[tuple[int, int], ...]
    worlds: int
    dtype: str
    dofs: int
    limbs: int = 1
    apart: bool = False
    varies: bool = False

    @property
    def few(self) -> bool:
        """So few worlds that a GPU waits for latency, not for instructions."""
        return self.worlds <= FEW_WORLDS

    @property
    def inward(self) -> tuple[tuple[int, int], ...]:
        """The levels from the deepest to the roots."""
        return self.outward[::-1]

    def of(self, operation: str) -> str:
        """Granularity of one operation: the plan's own where the operation has that form."""
        if operation in TREE_ONLY:
            return "tree"
        chosen = self.granularity if self.forced else self._rule(operation)
        if operation in SHARED:
            return "segment" if chosen == "segment" else "tree"
        return "tree" if chosen == "segment" and operation not in SEGMENTED else chosen

    def _rule(self, operation: str) -> str:
        if self.granularity == "node" or self.limbs == 1 or self.limbs > MOST_WARPS:
            return self.granularity
        if operation in (*LONG_RESULTS, "step"):  # of a step a thread holds too little even of a dozen dofs
            return "segment"
        if self.granularity == "segment" and not self.few:
            if operation in SHORT or (operation == "solve_mass_matrix" and self.dofs <= SOLVES[self.dtype]):
                return "tree"
        return self.granularity

    def stages(self, operation: str, warps: int) -> bool:
        """Whether rows come in through shared memory; ``warps`` share 32 worlds."""
        return self.staged and (warps == 1 or self.worlds > FEW_WORLDS // 4 or operation == "step")

    def gathers(self, operation: str, warps: int, results: int) -> bool:
        """Whether short results, so many, leave through shared memory, though rows do not come in so.

        ``warps`` share 32 worlds.
        """
        if warps > 1:
            return self.worlds > WARP_SIZE if self.dofs > LONG_ROWS else operation in GATHERED
        return results > FEW_RESULTS or (not self.few and (self.varies or operation in SHORT))

    def column_chunk(self, columns: int, bytes_per_column: int) -> int:
        """Right-hand sides that go through a solve at once."""
        return max(1, min(columns, COLUMN_BYTES // max(1, bytes_per_column)))


def choose(
    scene: Scene, worlds: int, cuda: bool, dtype: str, granularity: str | None = None, varies: bool = False
) -> Plan:
    """Return the plan for a scene and a world count; ``granularity`` forces one.

    ``varies``: inertias or hinge frames are inputs, which a thread has to hold too.

    Raises:
        ValueError: no such granularity.
    """
    if granularity is not None and granularity not in GRANULARITIES:
        names = ", ".join(GRANULARITIES)
        raise ValueError(f"Dynamics: granularity is {granularity!r}; expected None or one of {names}")
    asked = granularity or DEFAULT
    side_by_side = cuda and asked != "node" and 0 < scene.dof_count <= MOST_DOFS
    pieces = Pieces(Links(scene)) if side_by_side else None
    limbs, alike = (pieces.warps, pieces.alike >= ALIKE[dtype]) if pieces else (1, True)
    rule = _chosen(scene.dof_count, limbs, alike, worlds, cuda, dtype, varies)
    chosen, reason = (asked, "asked for") if asked else rule
    rows = SHORT_ROWS if chosen == "tree" else LONG_ROWS
    staged = scene.dof_count > rows and worlds > (FEW_WORLDS if scene.dof_count <= LONG_ROWS else FEW_WORLDS // 16)
    outward, first = [], 0
    for level in scene.tree.levels:
        outward.append((first, len(level)))
        first += len(level)
    apart = side_by_side and not varies and worlds > APART["chain" if limbs == 1 else chosen]
    apart = apart and _depth(scene) <= DEEPEST
    levels, dofs = tuple(outward), scene.dof_count
    return Plan(chosen, reason, asked is not None, staged, levels, worlds, dtype, dofs, limbs, apart, varies)


def _depth(scene: Scene) -> int:
    """Most dofs from a root to a leaf; a free hinge counts as one: nothing it carries is far from it."""
    depth: dict[int, int] = {-1: 0}
    for level in scene.tree.levels:
        for node in level:
            hinge = scene.hinges[scene.hinge_of[node]]
            depth[node] = depth[int(scene.tree.parent[node])] + hinge.depth
    return max(depth.values())


def _chosen(dofs: int, limbs: int, alike: bool, worlds: int, cuda: bool, dtype: str, varies: bool) -> tuple[str, str]:
    if dofs == 0:
        return "node", "nothing moves"
    if dofs > MOST_DOFS:
        return "node", f"more than {MOST_DOFS} dof take long to compile as straight-line code"
    if not cuda:
        return "tree", "one thread works through a world"
    if limbs == 1:
        return "tree", "the scene is one chain"
    if limbs > MOST_WARPS:
        return "tree", f"more than {MOST_WARPS} limbs"
    if worlds <= FEW_WORLDS:
        return "segment", f"up to {FEW_WORLDS} worlds, {limbs} limbs side by side take less time"
    if dofs > (min(HELD, SPILLS[dtype]) if varies else SPILLS[dtype]):
        if not alike:
            return "tree", f"{limbs} limbs with code of their own each do not fit into the instruction cache"
        return "segment", f"{dofs} dof in {dtype} do not fit into one thread's registers"
    return "tree", f"more than {FEW_WORLDS} worlds keep the GPU busy with a thread each"


def describe(plan: Plan) -> str:
    """One line: the choice, why, and what else there is."""
    others = ", ".join(name for name in GRANULARITIES if name != plan.granularity)
    staged = plan.stages("forward_dynamics", plan.limbs if plan.granularity == "segment" else 1)
    rows = "through shared memory" if staged else "each by its thread"
    first = "forward dynamics takes velocity terms first; " if plan.apart else ""
    return f"{plan.granularity}: {plan.reason}; rows are read {rows}; {first}granularity= can force {others}"
