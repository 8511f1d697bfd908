"""Every choice about how a scene runs on a device, made in one place and said aloud by ``explain()``."""

from __future__ import annotations

import dataclasses
import itertools

from ..errors import UnsupportedError
from ..kernels.long_results import WARP_SIZE
from ..recursions.model.links import Links
from ..recursions.model.segments import Segments
from ..scene.scene import Scene
from .device_facts import RESERVED, DeviceFacts
from .node.path_blocks import decompose, solid_nodes
from .routine import Routine
from .segment.schedule import PARTS
from .tuned import Tuned

SHARED, ASKED = "links share dofs", "asked for"
GRANULARITIES = ("node", "segment", "tree")
RECURSIONS = ("sweep", "scan")
DEFAULT: str | None = None  # granularity of who asks for none; None: chosen by the rules below
COLUMN_BYTES = 1 << 28  # workspace of a solve with many right-hand sides; more columns go in turns

# Measured on an H200, 2026-11-21; see CONTRIBUTING. Numbers of worlds and of threads are in proportion to its
# multiprocessors on another GPU, see DeviceFacts.scaled.
FEW_WORLDS = 32768  # so many leave a GPU waiting: a warp for each limb, and rows read where they are
SHARED_CODE_WORLDS = 40960  # up to so many, a warp for each limb is faster if limbs share code: Go2, 58 multiprocessors
MOST_DOFS = 128  # straight-line code of more takes too long to compile
SPILLS = {"float32": 32, "float64": 15}  # dofs at which one thread no longer holds a whole tree in registers,
SOLVES = {"float32": 32, "float64": 20}  # and at which it does not without velocities
# share of limbs that share code; below it a thread a world is faster then
LEAST_SHARED_CODE = {"float32": 0.5, "float64": 0.0}
SERIAL = 0.75  # share of the links on one path from a root, beyond which limbs cost more than they save, as fingers do
HELD = 16  # dofs of which a thread holds the variable values, too
SHORT_ROWS = 10  # dofs up to which a thread's own row is read as fast as through shared memory,
LONG_ROWS = 24  # in segments; longer rows come in together already at fewer worlds
FEW_RESULTS = 2  # short ones that a thread writes by itself
MOST_WARPS = 16
NODE_WORLDS = 1024  # of a CPU, beyond which a launch for each level only takes a large workspace
DEEPEST = 12  # dofs from a root to a leaf, a free hinge one, up to which velocity terms that come first are as accurate
VELOCITIES_FIRST = {"tree": {"float32": HELD, "float64": HELD}, "segment": SPILLS}  # dofs beyond which they are faster
AT_ONCE = 65536  # worlds that a GPU runs at once, a thread each with up to 128 registers
LEAST_SPILL_SLOTS = 28  # least number of places for values that are set aside; fewer do not save as many registers

# Measured on an H200, 2026-11-22, see benchmarks/depth.py. In a graph, a launch of a sweep takes 3.4 us and one of a
# scan 5 to 7 us, because a round of a scan is a product of two elements. A scan does three to five times the work of a
# sweep, so it pays while threads wait; with more worlds a thread takes more nodes.
BLOCK_LENGTH = 4  # nodes that a thread of a scan works through where few threads run; 8 are as fast, 2 and 16 slower
BLOCK_LENGTHS = (4, 16, 64)  # that are timed where plans are measured
SCAN_LAUNCH = 3  # launches of sweeps that take the time of one launch of a scan
SWEEPS = 4  # of forward dynamics: motion outward, factors and forces inward, accelerations outward
SCAN_THREADS = 32768  # path blocks times worlds that keep a GPU busy; with more a scan only does more work
# Measured on a CPU, 2026-11-22: whole paths as blocks take 0.1 ms for 256 bodies in one world, sweeps 8 ms, nearly
# all of it launches; at 16 worlds 1.3 against 6, and at 128 worlds 30 against 17.
CPU_WORLDS = 32


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
        device: what it is that runs them.
        dtype: "float32" or "float64".
        dofs: of the scene.
        leaf_segments: serial chains that end in a leaf; counted where it matters. segments_share_code: enough of them
            share code.
        bias_first: forward dynamics takes velocity terms and loads first, and keeps no link's velocity for the rest. It
            does not depend on the number of worlds, because the results have other bits.
        variable_inertia: inertias or hinge frames come from memory.
        block_length: at node granularity, scans do the work of most sweeps, with so many nodes for a thread, see
            :mod:`.scan`; 0: sweeps do.
        scan_reason: why.
        tuned: choices that were measured, by the routine's name; they replace the rules.
        tuned_plans: the plans by which the routines run whose choice is another granularity than that of the rules.
    """

    granularity: str
    reason: str
    forced: bool
    staged: bool
    outward: tuple[tuple[int, int], ...]
    worlds: int
    device: DeviceFacts
    dtype: str
    dofs: int
    leaf_segments: int = 1
    segments_share_code: bool = True
    bias_first: bool = False
    variable_inertia: bool = False
    block_length: int = 0
    scan_reason: str = ""
    tuned: dict[str, Tuned] = dataclasses.field(default_factory=dict)
    tuned_plans: dict[str, Plan] = dataclasses.field(default_factory=dict)

    @property
    def latency_bound(self) -> bool:
        """So few worlds that a GPU waits for latency, not for instructions."""
        return self.worlds <= self.device.scaled(FEW_WORLDS)

    @property
    def inward(self) -> tuple[tuple[int, int], ...]:
        """The levels from the deepest to the roots."""
        return self.outward[::-1]

    def of(self, routine: Routine) -> str:
        """Return the granularity of one routine: the plan's own where the routine has that form."""
        if routine.name in self.tuned_plans:
            return self.tuned_plans[routine.name].of(routine)
        if routine.segments is None and not routine.has_node_form:
            return "tree"
        chosen = self.granularity if self.forced else self._choose_for(routine)
        if chosen == "segment":
            return "segment" if routine.segments is not None else "tree"
        return chosen if routine.has_node_form else "tree"

    def _choose_for(self, routine: Routine) -> str:
        """Return the granularity that measured rules give a routine which has all forms; the first that applies.

        The plan's own granularity where the tree is not cut into several chains, or into too many for the warps of a
        block. Chains may divide work that spills the registers of one thread, and they cost barriers: "tree" where a
        thread holds the whole tree, "segment" where it does not, or where a GPU has too few worlds to fill it.
        """
        if self.granularity == "node" or self.leaf_segments == 1 or self.leaf_segments > MOST_WARPS:
            return self.granularity
        if routine.is_counted and not self.segments_share_code and self.dofs <= HELD:
            return "tree"
        if routine.hints.long_result or routine.passes is not None or routine.hints.crowded:
            return "segment"  # a thread holds too little even of a dozen dofs
        if self.granularity == "segment" and not self.latency_bound:
            if routine.hints.short or (not routine.hints.velocities and self.dofs <= SOLVES[self.dtype]):
                return "tree"
        return self.granularity

    def at(self, routine: Routine) -> Plan:
        """Return the plan by which a routine runs."""
        return self.tuned_plans.get(routine.name, self)

    def candidates(self, routine: Routine) -> tuple[str, ...]:
        """Return the granularities at which a routine may run here, those of the rules first."""
        first = self.of(routine)
        if self.forced or self.dofs > MOST_DOFS or not self.dofs:
            return (first,)
        divides = self.device.cuda and routine.segments is not None and 1 < self.leaf_segments <= MOST_WARPS
        sweeps = routine.has_node_form and not self.device.cuda and self.worlds <= NODE_WORLDS
        found = ["tree", *["segment"] * divides, *["node"] * sweeps]
        return (first, *(name for name in found if name != first))

    def block_lengths(self, scene: Scene) -> dict[str, int]:
        """Return the block lengths with which the sweeps of a scene may run here, by name, that of the rules first.

        0, named "sweep", is without scans. Of lengths that cut the tree alike the first counts.
        """
        if self.forced or self.scan_reason == ASKED or self.granularity != "node" or not self.dofs:
            return {name_block_length(self.block_length): self.block_length}
        lengths = BLOCK_LENGTHS if self.device.cuda else (scene.body_count, *BLOCK_LENGTHS)
        solid, known, found = solid_nodes(scene), [], [self.block_length, 0]
        for length in dict.fromkeys((self.block_length, *lengths)):
            blocks = decompose(scene.tree, solid, length) if length else None
            if (
                blocks is None
                or blocks.nodes in known
                or (self.variable_inertia and any(x.longest > 1 for x in blocks.levels))
            ):
                continue
            known.append(blocks.nodes)
            found.append(length)
        return {name_block_length(length): length for length in dict.fromkeys(found)}

    def stages(self, routine: Routine, warps: int) -> bool:
        """Whether rows come in through shared memory, for kernels in which ``warps`` share 32 worlds."""
        enough = self.worlds > self.device.scaled(FEW_WORLDS // 4)
        return self.at(routine).staged and (warps == 1 or enough or routine.passes is not None)

    def copies_directly(self, routine: Routine) -> bool:
        """Whether rows reach shared memory without passing through registers, with a thread a world.

        They come sooner, but the compiler then takes more registers; that costs nothing where all worlds run at once.
        """
        suits = routine.hints.short or routine.hints.waits_late
        return (
            suits
            and not self.variable_inertia
            and not self.latency_bound
            and self.worlds <= self.device.scaled(AT_ONCE)
        )

    def gathers(self, routine: Routine, warps: int, results: int) -> bool:
        """Whether short results leave through shared memory though rows do not come in through it.

        ``warps`` share 32 worlds; ``results`` is the number of results.
        """
        if warps > 1:
            return self.worlds > WARP_SIZE if self.dofs > LONG_ROWS else routine.hints.collects
        return results > FEW_RESULTS or (not self.latency_bound and (self.variable_inertia or routine.hints.short))

    def spill_slots(self, routine: Routine, shared_bytes: int, bytes_of: int, warps: int) -> int:
        """Return how many values each thread of a team sets aside in shared memory, to need fewer registers; 0: none.

        As many as leave room for all the blocks that ``routine.hints.registers_when_spilling`` registers allow.
        Measured on an H200, 2026-11-23: G1 with variable inertias takes 841 us for 919 at 2^20 worlds. With folded
        ones, and with a thread a world, the spills that they replace, or more registers, take less time.

        Args:
            shared_bytes: of the block without these values. bytes_of: of a value. warps: of the team.
        """
        if (
            not routine.hints.registers_when_spilling
            or not self.variable_inertia
            or self.latency_bound
            or bytes_of > 4
            or self.dofs <= SPILLS["float32"]
        ):
            return 0
        blocks = (
            PARTS * (self.device.registers // PARTS // (WARP_SIZE * routine.hints.registers_when_spilling)) // warps
        )
        room = self.device.shared_bytes // max(blocks, 1) - 3 * RESERVED - shared_bytes  # Warp takes a share, too
        places = room // (WARP_SIZE * warps * bytes_of)
        return places if places >= LEAST_SPILL_SLOTS else 0

    def fuses_substeps(self, granularity: str) -> bool:
        """Whether one kernel takes all substeps faster than a launch each.

        It does not where several blocks of 32 worlds share a multiprocessor and there are many dofs: blocks drift apart
        in the loop over substeps, and each then fetches for itself code that the instruction cache no longer holds, or
        values that the registers do not. Measured on an H200 in float32, 2026-11-23: up to 22 % slower. float64 has the
        same bounds, unmeasured.
        """
        most = SPILLS["float32"] if granularity == "segment" else HELD
        return not self.device.cuda or self.dofs <= most or self.worlds <= WARP_SIZE * self.device.multiprocessors

    def runs_beside(self, routine: Routine) -> bool:
        """Whether a routine that others do not wait for runs on a second stream beside them.

        Sweeps do not, because they share a workspace. With many worlds each kernel fills the GPU by itself.
        """
        return self.device.cuda and self.latency_bound and self.of(routine) != "node"

    @property
    def loops_over_links(self) -> bool:
        """Whether statements of links that are alike stand once in a traced kernel, see :mod:`..trace.equal_blocks`.

        They do on a CPU where there are so many dofs that a kernel in which they stand for each link takes long to
        compile. A GPU would hold what the loops keep in local memory, for all threads at once.
        """
        return self.dofs > MOST_DOFS and not self.device.cuda

    def column_chunk(self, columns: int, bytes_per_column: int) -> int:
        """Right-hand sides that go through a solve at once."""
        return max(1, min(columns, COLUMN_BYTES // max(1, bytes_per_column)))


def choose(
    scene: Scene,
    worlds: int,
    device: DeviceFacts,
    dtype: str,
    granularity: str | None = None,
    variable_inertia: bool = False,
    recursion: str | None = None,
) -> Plan:
    """Return the plan for a scene and a world count on a device; ``granularity`` and ``recursion`` force one.

    ``variable_inertia``: inertias or hinge frames are inputs, which a thread has to hold too.

    Raises:
        ValueError: no such granularity or recursion, or a scan at another granularity than "node".
    """
    _check_options(scene, granularity, recursion)
    shared = scene.shares_dofs
    asked = "tree" if shared else granularity or ("node" if recursion == "scan" else DEFAULT)
    side_by_side = device.cuda and not shared and asked != "node" and 0 < scene.dof_count <= MOST_DOFS
    segments = Segments(Links(scene)) if side_by_side else None
    leaf_segments, segments_share_code = (
        (len(segments.leaves), segments.shared_code_fraction >= LEAST_SHARED_CODE[dtype]) if segments else (1, True)
    )
    serial = segments is not None and segments.longest_path_fraction >= SERIAL
    rule = _choose_by_rule(
        scene.dof_count, leaf_segments, segments_share_code, serial, worlds, device, dtype, variable_inertia
    )
    chosen, reason = (asked, ASKED) if asked else rule
    if shared:
        reason = SHARED
    rows = SHORT_ROWS if chosen == "tree" else LONG_ROWS
    staged = scene.dof_count > rows and worlds > device.scaled(
        FEW_WORLDS if scene.dof_count <= LONG_ROWS else FEW_WORLDS // 16
    )
    bias_first = (
        side_by_side
        and not variable_inertia
        and _takes_velocities_first(scene, "tree" if leaf_segments == 1 else chosen, dtype)
    )
    if recursion is not None:
        block_length = BLOCK_LENGTH if recursion == "scan" else 0, ASKED
    elif chosen != "node" or not scene.dof_count:
        block_length = 0, ""
    else:
        block_length = (
            (0, "granularity is asked for") if asked else _choose_block_length(scene, worlds, device, variable_inertia)
        )
    sizes = [len(level) for level in scene.tree.levels]
    levels = tuple(zip(itertools.accumulate(sizes, initial=0), sizes, strict=False))
    return Plan(
        chosen,
        reason,
        asked is not None,
        staged,
        levels,
        worlds,
        device,
        dtype,
        scene.dof_count,
        leaf_segments,
        segments_share_code,
        bias_first,
        variable_inertia,
        *block_length,
    )


def _check_options(scene: Scene, granularity: str | None, recursion: str | None) -> None:
    """Raise an error if there is no such granularity or recursion, or none such of the scene."""
    for name, value, known in (("granularity", granularity, GRANULARITIES), ("recursion", recursion, RECURSIONS)):
        if value is not None and value not in known:
            raise ValueError(f"Dynamics: {name} is {value!r}; expected None or one of {', '.join(known)}")
    if recursion == "scan" and granularity not in (None, "node"):
        raise ValueError(
            f"Dynamics: recursion is 'scan' and granularity is {granularity!r}; expected granularity 'node' or None, "
            f"because kernels of other granularities sweep"
        )
    if scene.shares_dofs and (granularity in ("node", "segment") or recursion == "scan"):
        option = f"granularity={granularity!r}" if granularity else "recursion='scan'"
        what, way = f"{option} for a scene with flexible bodies or rotors", "use granularity=None or 'tree'"
        raise UnsupportedError("Dynamics", what, way if granularity else "leave recursion out")


def _choose_block_length(scene: Scene, worlds: int, device: DeviceFacts, variable_inertia: bool) -> tuple[int, str]:
    """Return how many nodes a thread of a scan takes, 0 if sweeps take less time than scans, and why."""
    solid, length = solid_nodes(scene), BLOCK_LENGTH if device.cuda else scene.body_count
    blocks = decompose(scene.tree, solid, length)
    while device.cuda and length < scene.body_count and worlds * len(blocks.nodes) > device.scaled(SCAN_THREADS):
        length *= 2
        blocks = decompose(scene.tree, solid, length)
    scans, sweeps = blocks.launches, SWEEPS * len(scene.tree.levels)
    counts = f"{scans} launches in a row against {sweeps} of sweeps"
    if SCAN_LAUNCH * scans >= sweeps:
        return 0, f"scans would be {counts}"
    if variable_inertia and any(level.longest > 1 for level in blocks.levels):
        return 0, "scans begin at bodies that have inertia, which variable values may take away"
    threads, most = (len(blocks.nodes), device.scaled(SCAN_THREADS)) if device.cuda else (1, CPU_WORLDS)
    if worlds * threads > most:
        return 0, f"with {worlds} worlds the work takes longer than launches; scans would be {counts}"
    return length, f"{counts}, a thread takes up to {length} nodes"


def name_block_length(length: int) -> str:
    """Return the name of sweeps without scans, or of scans with so many nodes for a thread."""
    return f"scan of {length}" if length else "sweep"


def _takes_velocities_first(scene: Scene, granularity: str, dtype: str) -> bool:
    """Return whether forward dynamics with velocity terms first is faster at a granularity, and as accurate."""
    return scene.dof_count > VELOCITIES_FIRST[granularity][dtype] and _depth(scene) <= DEEPEST


def _depth(scene: Scene) -> int:
    """Most dofs from a root to a leaf; a free hinge counts as one: nothing it carries is far from it."""
    depth: dict[int, int] = {-1: 0}
    for level in scene.tree.levels:
        for node in level:
            hinge = scene.hinges[scene.hinge_of[node]]
            depth[node] = depth[int(scene.tree.parent[node])] + hinge.depth
    return max(depth.values())


def _choose_by_rule(
    dofs: int,
    leaf_segments: int,
    segments_share_code: bool,
    serial: bool,
    worlds: int,
    device: DeviceFacts,
    dtype: str,
    variable_inertia: bool,
) -> tuple[str, str]:
    held = min(HELD, SPILLS[dtype]) if variable_inertia else SPILLS[dtype]
    few_worlds = device.scaled(SHARED_CODE_WORLDS if segments_share_code else FEW_WORLDS)
    if dofs == 0:
        return "node", "nothing moves"
    if dofs > MOST_DOFS:
        return "node", f"more than {MOST_DOFS} dof take long to compile as straight-line code"
    if not device.cuda:
        return "tree", "one thread works through a world"
    if leaf_segments == 1:
        return "tree", "the scene is one chain"
    if leaf_segments > MOST_WARPS:
        return "tree", f"more than {MOST_WARPS} limbs"
    if serial and dofs <= held:
        return "tree", "most of its links are on one path, so that limbs side by side save no time"
    if worlds <= few_worlds:
        return "segment", f"up to {few_worlds} worlds, {leaf_segments} limbs side by side take less time"
    if dofs > held:
        if not segments_share_code:
            return "tree", f"{leaf_segments} limbs with code of their own each do not fit into the instruction cache"
        return "segment", f"{dofs} dof in {dtype} do not fit into one thread's registers"
    return "tree", f"more than {few_worlds} worlds keep the GPU busy with a thread each"


def describe(plan: Plan) -> str:
    """Return one line: the granularity, the reason for it, and the other granularities."""
    others = ", ".join(name for name in GRANULARITIES if name != plan.granularity)
    leaf_segments = plan.leaf_segments if plan.granularity == "segment" else 1
    staged = plan.staged and (leaf_segments == 1 or plan.worlds > plan.device.scaled(FEW_WORLDS // 4))
    rows = "through shared memory" if staged else "by each thread for itself"
    first = "forward dynamics takes velocity terms first; " if plan.bias_first else ""
    force = "no other granularity serves them" if plan.reason == SHARED else f"granularity= can force {others}"
    return f"{plan.granularity}: {plan.reason}; rows are read {rows}; {first}{force}"


def describe_recursion(plan: Plan) -> str:
    """Return one line: whether node granularity sweeps or scans, and the reason for it."""
    chosen, other = RECURSIONS[::-1] if plan.block_length else RECURSIONS
    return f"{chosen}: {plan.scan_reason}; recursion= can force {other}"
