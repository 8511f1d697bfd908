"""Programs: a routine of one scene as one kernel, traced, emitted, compiled at its first use and launched.

At tree granularity a thread works on one world, in program order. At segment granularity a warp works on one serial
chain of 32 worlds, a block on 32 worlds; limbs of equal structure run one text, in which what differs is read from a
table.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import warp as wp

from .. import launches
from ..kernels import couples as couple_points
from ..kernels import coupling, coupling_teams, native, straight
from ..kernels.elementary import C_TYPE
from ..kernels.fields import axes
from ..kernels.native import INTEGERS
from ..kernels.slots import WARP_SIZE
from ..kernels.straight import BY_TABLE, DIRECT, RELAYED, TILED, KernelLayout
from ..kernels.substeps import SUBSTEPS
from ..recursions import alike, body_frames, messages
from ..recursions.contact import coupled, pair_pieces, pairs
from ..recursions.contact.couples import Team as Couplings
from ..recursions.contact.ground import GROUND
from ..recursions.contact.points import own_points
from ..recursions.contact.secants import SECANT
from ..recursions.contact.ties import couples_of
from ..recursions.flexible import attach
from ..recursions.links import TABLES, Links
from ..recursions.messages import INWARD, OUTWARD
from ..recursions.pieces import PARTS, Pieces
from ..recursions.step import FORCE, GAIN, GUESS, LOOPED, MISSED, RESISTANCE
from ..recursions.tracing import Trace
from ..scene.contacts import HeightField
from ..trace.emission import Store, render, under
from ..trace.scalars import Scalar, is_literal
from ..trace.set_aside import set_aside
from . import link_values, products, searches, staging
from .access import make_emitter
from .device_facts import RESERVED
from .plan import MOST_WARPS, Plan
from .routine import Routine
from .sweeps import Sweeps
from .teams import HELD, Passes, Team, Work

PASSED = (*LOOPED, SECANT, FORCE, RESISTANCE)  # variables of the loops over passes
MOST_REGISTERS = 255  # of a thread
BODIES = "bodies"  # option of a step by limbs whose kernel writes the states of bodies, too
PAIR = 2  # warps of a block that share nothing: fewer blocks start sooner


class Program(NamedTuple):
    """One kernel.

    Attributes:
        rows: names of the callers' arrays, and then numbers, that it reads. fields: of FIELDS.
        tables: arrays of its own.
        operations: floating-point operations of one world.
        slots: values of one world in the tiles that it writes; places, entry: where each entry of the result is among
            them, -1 being zero, on the host and on the device. See :mod:`warp_spo.kernels.tiles`.
    """

    kernel: wp.Kernel
    rows: tuple[str, ...]
    fields: tuple[str, ...]
    tables: tuple[wp.array, ...]
    warps: int
    block: int
    operations: int
    slots: int = 0
    places: tuple[int, ...] = ()
    entry: Any = None


class Gathered(NamedTuple):
    """The work of all pieces before it is one text.

    Attributes:
        table: which value each entry of the result receives, if a table says so. sent: the scalars that pieces send.
        looks_up: some piece reads heights. couples: the pairs of bodies. numbers: the constants of each piece.
    """

    team: Team
    layout: KernelLayout
    table: list[int] | None
    sent: int
    looks_up: bool
    couples: Couplings | None
    numbers: list[alike.Numbers]


class Programs:
    """The programs of one scene.

    Args:
        run: its sweeps, whose parameters the programs read.
        plan: which granularity each operation has.

    Attributes:
        relays: what is too long for shared memory waits in the rows of the result.
    """

    def __init__(self, run: Sweeps, plan: Plan):
        self.run, self.plan = run, plan
        self.relays = run.device.is_cuda
        self._programs: dict[tuple, Program | None] = {}
        self._products: dict[tuple[int, ...], products.Product] = {}
        self._links: Links | None = None

    def forget(self) -> None:
        """Drop all programs: values that they folded have changed."""
        self._programs.clear()
        self._products.clear()
        self._links = None

    def find(
        self,
        routine: Routine,
        shapes: dict[str, tuple[int, ...]],
        out: tuple[int, ...],
        more: dict[str, tuple[int, ...]] | None = None,
        **options: Any,
    ) -> Program | None:
        """Return the program of a routine for arrays of these shapes; None where the routine's sweeps serve them.

        Args:
            shapes: of the arrays that the routine reads, [world, ...].
            out: shape of the result, [world, ...]. more: shapes of further results, by name.
            options: of the routine's trace.
        """
        names = (name if shape else f"{name}, a number" for name, shape in shapes.items())
        key = routine, (*names, *(more or ())), out[1:], self.plan.of(routine), *options.values()
        if key in self._programs:
            return self._programs[key]
        if self.plan.of(routine) == "node":
            return None
        variants = sum(1 for other in self._programs if other[0] is routine)
        if options and variants >= routine.variants and routine.has_node_form:
            return None
        self._programs[key] = self._build(routine, shapes, out, more or {}, options)
        return self._programs[key]

    def launch(self, program: Program, arrays: dict[str, Any], out: wp.array, *more: wp.array) -> None:
        rows = [arrays[name] for name in program.rows]
        fields = [self.field(name) for name in program.fields]
        inputs, worlds, block = [*rows, *fields, *program.tables], self.run.worlds, program.block
        of_block = block // program.warps
        threads = -(-worlds // of_block) * block if self.run.device.is_cuda else worlds
        launches.launch(
            program.kernel, threads, [worlds, *inputs], [out, *more], device=self.run.device, block_dim=block
        )

    def product(self, program: Program, size: int) -> products.Product:
        """Return the kernel of -A B for the first two matrices [``size``, ``size``] of a program's result in tiles."""
        if program.places not in self._products:
            found = products.build(size, program.places, program.slots, self.run.dtype, self.run.device)
            self._products[program.places] = found
        return self._products[program.places]

    def field(self, name: str) -> wp.array:
        """One of FIELDS."""
        if name not in TABLES:
            return self.run.parameters.field(name)
        return link_values.table(self.run.parameters, self.links, name)

    @property
    def operation_counts(self) -> dict[str, int]:
        """Floating-point operations of one world, by operation."""
        return {_title(key): program.operations for key, program in self._used}

    @property
    def _used(self) -> list[tuple[tuple, Program]]:
        """The programs at the granularity that the plan gives now; others stay for graphs that hold them."""
        found = self._programs.items()
        return [(key, program) for key, program in found if program is not None and key[3] == self.plan.of(key[0])]

    def warps(self, routine: Routine) -> int | None:
        """Return how many warps share worlds in a routine's kernels; None before one is built."""
        return max((program.warps for key, program in self._used if key[0] is routine), default=None)

    def described(self) -> list[str]:
        """A line for each kernel: its granularity, its operations in one world, and on CUDA what it takes."""
        lines = []
        for key, program in self._used:
            granularity = f"segment, {program.warps} warps" if program.warps > 1 else "tree"
            line = f"{_title(key)}  {granularity}, {program.operations} operations a world"
            if self.run.device.is_cuda:
                found = wp.get_cuda_kernel_properties(program.kernel, self.run.device, program.block)
                line += f", {found['register_count']} registers, {found['local_memory_size']} bytes of stack a thread"
            lines.append(line)
        return lines

    # -- building --------------------------------------------------------------------------------------------------
    @property
    def links(self) -> Links:
        if self._links is None:
            self._links = Links(self.run.scene, self.run.parameters.variable)
        return self._links

    def _copied(self, options: dict, copies: bool = False) -> Links:
        """Return links of their own for one trace, with what the frames in its options sit on."""
        links = self.links.with_tables(copies)
        attach(links, ((body, place[:3]) for body, place in options.get("frames", ())))
        return links

    def _build(self, routine: Routine, shapes: dict, out_shape: tuple, more: dict, options: dict) -> Program | None:
        links, shapes = self._copied(options), {**shapes, "out": out_shape}
        if not links.links or not routine.suits(links, shapes, **options):
            return None
        if routine.start is not None:
            return searches.build(self, routine, links, "given" in shapes, options)
        shared = self.plan.of(routine) == "segment" and routine.divides(self.run.scene, shapes, **options)
        if routine.bias_first is not None and self.plan.at(routine).apart and "qd" in shapes:
            routine = routine.bias_first
        attempts = [(False, False)] if shared else []
        if routine.couples and not coupled.suits(links) and routine.divides(self.run.scene, shapes, **options):
            attempts += [(True, False), (True, True)]
        pieces = Pieces(links) if attempts else None
        for alone, local in attempts:
            assert pieces is not None
            several = 1 < pieces.warps <= MOST_WARPS or alone
            both = {**shapes, **more}
            form = (alone, local)
            program = self._segment_program(routine, both, pieces, tuple(more), options, *form) if several else None
            if program is not None:
                return program
        if options.get(BODIES):
            return None
        return self._tree_program(routine, links, {**shapes, **more}, tuple(more), options)

    def _tree_program(self, routine: Routine, links: Links, shapes: dict, more: tuple, options: dict) -> Program:
        trace = Trace(links, self.run.dtype.__name__, tuple(shapes))
        stores = [self._flattened(item, shapes) for item in routine.trace(trace, **options)]
        apart = [item for item in stores if item.array in more]  # each straight to memory
        outs = [item for item in stores if item.array == "out"]
        looped = [item for item in stores if item.array in (*PASSED, coupled.TWIST)]
        aggregates = any(item.array == coupled.TWIST for item in stores)
        kept = [Store("ahead", (), value) for value in trace.ahead] if looped else []  # may read what no store needs
        layout = self._layout(routine, outs, trace.begin + stores + kept, shapes, more)
        once = routine.passes or any(item.array in LOOPED for item in stores)  # may write over what it reads
        layout = layout._replace(
            retries=not once and not layout.staged and layout.result.way in (DIRECT, TILED, RELAYED)
        )
        placed, table = staging.arrange_stores(outs, layout.result)
        placed += apart
        emitter = make_emitter(self.run.dtype.__name__, shapes, layout, branches=aggregates)
        responses = [item for item in stores if item.array in pairs.READ]
        regions = [emitter.region(trace.begin, trace.ahead)] if looped else []
        regions += emitter.branches([responses, looped] if responses else [looped]) if looped else []
        *before, body = (render(each, self.run.dtype.__name__) for each in [*regions, emitter.region(placed)])
        if trace.begin:
            entries = {
                GAIN: self.run.scene.dof_count,
                SECANT: max(1, sum(item.array == SECANT for item in trace.begin)),
            }
            if responses:
                couples = self._couples(links)
                entries |= coupling.shared_arrays(couples)
                first, read, *rest = before
                declared = coupling.declare(couples, self.run.dtype)
                before = [f"{declared}\n{first}\n{coupling.BEGIN}", "\n".join([read, coupling.PASS, *rest])]
            if aggregates:
                found = self._aggregated(links, options, coupled.REPORT in body)
                entries |= couple_points.arrays(found)
                first, a_pass = before
                declared = couple_points.declare(found, self.run.dtype)
                before = [f"{declared}\n{first}\n{couple_points.BEGIN}", f"{a_pass}\n{couple_points.PASS}"]
            body = straight.repeat_counted_passes([*before, body], entries, self.run.dtype)
        elif looped:
            ahead, a_pass = before
            body = straight.repeat_passes(ahead, a_pass, body, LOOPED, self.run.scene.dof_count, self.run.dtype)
        direct = layout.staged and self.plan.copies_directly(routine)
        late = direct and routine.waits_late
        block = PAIR * WARP_SIZE if late or (self.plan.few and not layout.shared_scalars) else WARP_SIZE
        layout = layout._replace(retries=layout.retries and "farthest" in body, block=block, direct=direct, late=late)
        tables: dict[str, Any] = {} if table is None else {"place": table}
        tables |= self._heights(emitter.counts["lookup"] > 0)
        if responses:
            tables["touches"] = self.run.array(*self._touches(couples.points))
        return self._finished(routine, layout, body, body, tables, emitter.operations)

    def _heights(self, reads: bool) -> dict[str, Any]:
        """Return the table of the ground's cells, if a program ``reads`` it."""
        ground = self.run.scene.ground
        return {GROUND: self.run.parameters.ground_cells} if reads and isinstance(ground, HeightField) else {}

    def _segment_program(
        self, routine: Routine, shapes: dict, pieces: Pieces, more: tuple, options: dict, alone: bool, local: bool
    ) -> Program | None:
        """Return the program in which limbs share the work, None if there is no room.

        ``alone``: one thread takes them all. ``local``: it keeps what they tell each other in memory of its own.
        """
        found = self._team(routine, shapes, pieces, more, options, alone, local, [frozenset()] * len(pieces.pieces))
        if found is not None and self._unfolds(routine):
            apart = alike.differing(pieces.pieces, found.numbers, found.team.texts)
            other = self._team(routine, shapes, pieces, more, options, alone, local, apart) if any(apart) else None
            if other is not None and len(set(other.team.texts)) < len(set(found.team.texts)):
                found = other
        return None if found is None else self._team_program(routine, pieces, found, alone, local)

    def _team(
        self,
        routine: Routine,
        shapes: dict,
        pieces: Pieces,
        more: tuple,
        options: dict,
        alone: bool,
        local: bool,
        unfolded: list[frozenset],
    ) -> Gathered | None:
        """Return the work of all pieces, None if there is no room.

        ``unfolded``: by piece, constants that do not fold, see :mod:`..recursions.alike`.
        """
        letters = messages.needed(routine.letters, shapes)
        by_frames = BODIES in options and body_frames.suits(self.links)
        letters = letters if by_frames else letters.replace("F", "")
        dtype, (slots, sent) = self.run.dtype.__name__, messages.slots(letters, pieces)
        slot = lambda letter, piece: slots[letter, piece.index]  # noqa: E731
        couples = self._team_of_pairs(slots, sent) if routine.couples else None
        sent = couples.layout["end"] if couples is not None else sent
        numbers: list[alike.Numbers] = []
        everything: list[Store] = []
        traced: list[list[Store]] = []
        apart: list[tuple[list[list[Store]], list[list[Store]], list[Store], list[list[Store]], list[list[Store]]]] = []
        begins: list[list[Store]] = []  # what each piece stores and sends before its passes
        held: list[list[Scalar]] = []  # what each piece computes once before its passes
        responses: list[
            tuple[list[tuple[int, list[Store]]], list[Any]]
        ] = []  # what each piece leaves for pairs of bodies
        for index in range(len(pieces.pieces)):
            links = self._copied(
                options, self._unfolds(routine)
            )  # its own: pieces of equal structure then give equal text
            trace = Trace(links, dtype, tuple(shapes), Pieces(links).pieces[index], slot)
            trace.team = couples
            if self._unfolds(routine) and trace.piece is not None:
                points = [number for number, _ in own_points(trace)]
                links.numbers = alike.Numbers(links.graph, trace.piece, points, unfolded[index])
                numbers.append(links.numbers)
            traced.append([self._flattened(item, shapes) for item in routine.trace(trace, **options)])
            rounds = [[self._flattened(item, shapes) for item in turn] for turn in trace.rounds]
            news = [self._flattened(item, shapes) for item in trace.news]
            bodies = [[self._flattened(item, shapes) for item in turn] for turn in trace.states]
            apart.append((trace.laws, trace.checks, news, rounds, bodies))
            begins.append(trace.begin)
            responses.append((trace.couples, trace.carried))
            held.append(list({x.key: x for x in trace.ahead if not is_literal(x) and x.op != "input"}.values()))
            everything += trace.begin + traced[-1] + news
            everything += [item for turn in (*trace.laws, *trace.checks, *rounds, *bodies) for item in turn]
            everything += [item for _, items in trace.couples for item in items]
        bends = any(item.array == MISSED for item in everything)
        held = held if bends or routine.counted else [[] for _ in held]
        sizes = {index: len(values) for index, values in enumerate(held)}
        kept = (GUESS, GAIN, FORCE, RESISTANCE) if any(laws for laws, *_ in apart) else (GUESS, GAIN)
        passes = Passes(kept, sent if bends else None, sizes) if routine.passes else None
        if routine.counted:
            counts = [sum(item.array == SECANT for item in begin) for begin in begins]
            passes = Passes((GAIN,), None, sizes, dict(enumerate(counts)))
        sent += 2 * pieces.warps if bends else 0
        whole = [item for item in everything if item.array == "out"]
        layout = self._layout(
            routine, whole, everything, shapes, more, 0 if local else sent, 1 if alone else pieces.warps
        )
        if layout.result.way == DIRECT and layout.result.array.entries > staging.LONG_ROW:
            return None  # no room for the result in shared memory, which matters more
        if not layout.fits(self.run.dtype, self.room(routine.wide, routine.couples, BODIES in options)):
            return None  # nor for what limbs tell each other
        if options.get(BODIES) and not layout.further_staged:
            return None  # nor for the states of bodies, which another kernel then writes
        declared = "" if couples is None else coupling_teams.declare(couples, self.run.dtype, local)
        team, looks_up = Team(pieces, dtype, passes, declared), False
        outs = [[item for item in stores if item.array == "out"] for stores in traced]
        placed, table = staging.arrange_stores(whole, layout.result)
        outs[0] += placed[len(whole) :] if table is None else []  # zeros
        by_slot = lambda found: found if table is None else staging.stores_by_slot(found, table)  # noqa: E731
        for piece, stores, items, (laws, checks, news, rounds, bodies), begin, values, (
            response,
            carried,
        ) in zip(pieces.pieces, traced, outs, apart, begins, held, responses, strict=True):
            first, emitter, later, *others = (make_emitter(dtype, shapes, layout, True) for _ in range(5))
            ruling, checking = others
            ahead = first.region([*begin, *(Store(HELD, (at,), value) for at, value in enumerate(values))])
            later = later if passes else emitter
            emitter.keep(HELD, values)
            if routine.counted:
                later.keep(HELD, values)  # other pieces may have written over what these come from
            inward = [item for item in stores if item.array == INWARD]
            outward = [item for item in stores if item.array == OUTWARD]
            last = outward if set(letters) & set(messages.OUTWARD_LETTERS) else inward
            last += by_slot(items)
            last += [item for item in stores if item.array in (*more, GAIN, SECANT)]
            sweep = emitter.region(inward, carried)
            response = [under(emitter.branch(items), "SENT({}) > 0", INWARD, flag) for flag, items in response]
            regions = sweep, emitter.region(outward)
            ends = [item for item in news if item.array == "out"]
            news = [item for item in news if item.array != "out"] + by_slot(ends)
            branches = later.branch(news), [later.branch(by_slot(turn)) for turn in rounds]
            own = [(make_emitter(dtype, shapes, layout, True), turn) for turn in bodies]
            states = [emitter.region(turn) for emitter, turn in own]
            turns = [ruling.branch(turn) for turn in laws], [checking.branch(turn) for turn in checks]
            work = Work(piece, *regions, *turns, *branches, ahead, response, states)
            emitters = {first, emitter, later, *others, *(emitter for emitter, _ in own)}
            team.add(work, sum(each.operations for each in emitters))
            looks_up |= any(each.counts["lookup"] for each in emitters)
        return Gathered(team, layout, table, sent, looks_up, couples, numbers)

    def _unfolds(self, routine: Routine) -> bool:
        """Return whether constants in which limbs differ may be kept from folding; without contacts they all fold."""
        return routine.alike and bool(self.run.scene.contacts)

    def _team_program(self, routine: Routine, pieces: Pieces, found: Gathered, alone: bool, local: bool) -> Program:
        """Return the program of a team."""
        team, layout, table, sent, looks_up, couples, _ = found
        dtype = self.run.dtype.__name__
        cpu = team.cpu()
        if local:
            cpu = f"{C_TYPE[self.run.dtype]} sent[{sent}];\n#undef SENT\n#define SENT(i) sent[i]\n{cpu}"
        cuda = cpu if alone else team.cuda()  # fills the tables
        registers = self._registers(1 if alone else pieces.warps)
        if dtype == "float32" and not self.plan.few:
            for blocks, enough in routine.occupancy:
                fewer = self._registers(blocks * pieces.warps)
                room = blocks * (layout.shared_bytes(self.run.dtype) + RESERVED) <= self.plan.device.shared_bytes
                if fewer >= enough and room:
                    registers = fewer
                    break
        T = self.run.dtype
        bytes_of = wp.types.type_size_in_bytes(T)
        if places := self.plan.places_aside(routine, layout.shared_bytes(T), bytes_of, layout.warps):
            layout, registers = layout._replace(aside=places), routine.aside
            cuda = set_aside(cuda, C_TYPE[T], places)
        lists = {"place": table, "table": team.table, "shifts": team.shifts}
        if team.shares_bodies:
            lists[body_frames.GEOMETRY] = body_frames.geometry(self.run.scene)
            name = body_frames.GEOMETRY.upper()
            cuda = f"#define {name}(i) __ldg(geometry.data + i)\n{cuda}\n#undef {name}"
            cpu = f"#define {name}(i) geometry.data[i]\n{cpu}\n#undef {name}"
        tables = {name: values for name, values in lists.items() if values} | self._heights(looks_up)
        if couples is not None:
            tables["touches"] = self.run.array(*self._touches(couples.points))
        cap = registers if registers < MOST_REGISTERS else None
        return self._finished(routine, layout, cuda, cpu, tables, team.operations, cap)

    def _touches(self, points: tuple[int, ...]) -> tuple[str, int, int]:
        """Return name and shape of the array of touches, for so many points of each pair."""
        return "touches", coupling.entries(points)[-1], coupling.columns(self.run.worlds)

    def _team_of_pairs(self, slots: dict[tuple[str, int], int], first: int) -> Couplings:
        """Return the pairs of bodies as a team couples them, with values from ``first`` on among those of messages."""
        seats = pair_pieces.seats_of(self.links, pieces := Pieces(self.links))
        alpha = -1 if seats is None or seats.base is None else slots["a", seats.base.index]
        return pair_pieces.team(self.links, pieces, alpha, first)

    @staticmethod
    def _couples(links: Links) -> coupling.Couples:
        """Return the pairs of bodies of a scene as their native code needs them."""
        scene, of_pairs = links.scene, pairs.members(links).of_pairs
        points, eps = zip(*((pair.points, pair.eps) for pair in scene.contact_pairs), strict=True)
        return coupling.Couples(
            of_pairs, points, eps, tuple(pairs.inverse_weights(scene)), pairs.blocks(links), pairs.solids_of(links)[0]
        )

    @staticmethod
    def _aggregated(links: Links, options: dict, reports: bool) -> couple_points.Couples:
        """Return the pairs of bodies of a scene as aggregates couple them, as their native code needs them."""
        scene, couples = links.scene, couples_of(links)
        signs = dict(one for couple in couples for one in zip(couple.pairs, couple.signs, strict=True))
        points, eps = zip(*((pair.points, pair.eps) for pair in scene.contact_pairs), strict=True)
        looks = bool({"contact_gap", "contact_slip"} & set(options.get("reports", ())))
        return couple_points.Couples(
            tuple(couple.pairs for couple in couples), tuple(signs[i] for i in range(len(points))), points, eps,
            tuple(pairs.inverse_weights(scene)), pairs.solids_of(links)[0], looks, reports,
        )  # fmt: skip

    @staticmethod
    def _flattened(item: Store, shapes: dict) -> Store:
        if item.array in (INWARD, OUTWARD, *PASSED, *pairs.READ, *coupled.ARRAYS):
            return item
        return item._replace(index=(staging.flat_index(item.index, shapes[item.array][1:]),))

    def _finished(
        self,
        routine: Routine,
        layout: KernelLayout,
        cuda: str,
        cpu: str,
        tables: dict,
        operations: int,
        registers: int | None = None,
    ) -> Program:
        text = straight.assemble(layout, cuda, cpu, self.run.dtype)
        rows, fields = (*(row.name for row in layout.rows), *layout.numbers), tuple(layout.fields)
        arrays = [(row.name, row.ndim) for row in layout.rows] + [(name, 0) for name in layout.numbers]
        arrays += [(name, axes(name)) for name in fields]
        result, entry, places = layout.result, None, ()
        if result.way in BY_TABLE:
            tables = tables | {"place": result.slot_layout.table(tables["place"], self.run.dtype)}
        held: dict[str, wp.array] = {
            name: values
            if isinstance(values, wp.array)
            else wp.array(values, dtype=int if name in INTEGERS else self.run.dtype, device=self.run.device)
            for name, values in tables.items()
        }
        if result.way == TILED:
            entry, places = held.pop("place"), tuple(tables["place"])
        arrays += [(name, array.ndim) for name, array in held.items()]
        arrays += [("out", result.array.ndim if entry is None else 3)] + [
            (row.name, row.ndim) for row in layout.further
        ]
        asks = layout.shared_bytes(self.run.dtype) if layout.asks_for_shared_memory(self.run.dtype) else 0
        kernel = native.kernel(routine.name, text, arrays, self.run.dtype, registers, shared=asks)
        return Program(
            kernel,
            rows,
            fields,
            tuple(held.values()),
            layout.warps,
            layout.block,
            operations,
            result.slots,
            places,
            entry,
        )

    def room(self, wide: bool = False, couples: bool = False, whole: bool = False) -> int:
        """Bytes of shared memory that a block may have: for as many scalars in float64 as in float32 if the GPU can.

        ``wide``: for long rows that all go through it. ``couples``: for what limbs couple in it. ``whole``: all that a
        multiprocessor has.
        """
        more = straight.COUPLED_BYTES if couples else straight.WIDE_BYTES if wide else 0
        wanted = max(straight.SHARED_BYTES, more) * wp.types.type_size_in_bytes(self.run.dtype) // 4
        allowed = self.plan.device.shared_bytes - 3 * RESERVED  # Warp takes a share, too
        wanted = max(wanted, allowed) if whole else wanted
        return min(wanted, max(allowed, straight.SHARED_BYTES)) if self.plan.device.cuda else wanted

    def _registers(self, warps: int) -> int:
        """Of a thread, if a multiprocessor is to hold so many warps: its parts share them, each with its registers."""
        return self.plan.device.registers // PARTS // (WARP_SIZE * -(-warps // PARTS)) // 8 * 8

    def _layout(
        self,
        routine: Routine,
        stores: list[Store],
        everything: list[Store],
        shapes: dict,
        more: tuple,
        sent: int = 0,
        warps: int = 1,
    ) -> KernelLayout:
        whole = "poses_out" in more
        gathers = whole or self.plan.gathers(routine, warps, 1 + len(more))
        ways = self.plan.stages(routine, warps), gathers, routine.tiled
        wide = routine.wide and warps > 1
        dtype, relays, room = self.run.dtype, self.relays, self.room(wide, whole=whole)
        return staging.choose_layout(stores, everything, shapes, more, sent, warps, dtype, *ways, relays, room, wide)


def _title(key: tuple) -> str:
    """Return what the user calls the computation of a program."""
    routine, inputs, _, _, *options = key
    title = routine.name if routine.title is None else routine.title(inputs, *options)
    return f"{title} of substeps" if f"{SUBSTEPS}, a number" in inputs else title
